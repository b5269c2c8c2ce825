"""The behavior tree: threats, rollouts, leaves."""
