"""What only the simulator knows."""


class Truth:
    """Base of structs and sections that no stage of the stack may name, nor be handed:
    ``tests/test_architecture.py`` reads it."""
