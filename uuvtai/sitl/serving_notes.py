"""What ``uuv sitl`` says while it serves: who speaks, who does not, what begins and ends. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.sitl.instance import Instance

SILENT_S = 10.0
"""by the clock, without a packet"""


@dataclass
class _Seen:
    packets: int = 0
    bad: int = 0
    resets: int = 0
    heard_s: float = 0.0
    silence_told: bool = False
    held: bool = True
    outcome: str = ""


class ServingNotes:
    """Of one instance. ``look`` is called often."""

    def __init__(self, number: int, port: int, now_s: float) -> None:
        self._name, self._port = f"instance {number}", port
        self._seen = _Seen(heard_s=now_s)

    def look(self, instance: Instance, now_s: float) -> list[str]:
        """Sentences about what is new."""
        seen, counts = self._seen, instance.counts
        found = [*self._packets(instance, now_s), *self._episode(instance)]
        if counts["bad"] > 0 and seen.bad == 0:
            found.append(
                f"{self._name}: what comes to port {self._port} is no packet of ArduSub's, or a second "
                "ArduSub's: does it run with --model JSON, and -I counting from 0?"
            )
        seen.bad = counts["bad"]
        return found

    def _packets(self, instance: Instance, now_s: float) -> list[str]:
        seen, counts = self._seen, instance.counts
        packets = sum(counts[name] for name in ("step", "reset", "again", "ignore"))
        if packets > seen.packets:
            was_silent = seen.silence_told or seen.packets == 0
            first = seen.packets == 0
            seen.packets, seen.heard_s, seen.silence_told = packets, now_s, False
            found = [f"{self._name}: ArduSub speaks"] if was_silent else []
            if counts["reset"] > max(1, seen.resets):
                found.append(f"{self._name}: ArduSub has begun anew, so has the episode")
            if first and instance.joined_late:
                found.append(
                    f"{self._name}: ArduSub is under way already, and takes itself for where it was: nobody "
                    "operates it; restart it, and the pilot"
                )
            seen.resets = counts["reset"]
            return found
        if now_s - seen.heard_s < SILENT_S or seen.silence_told:
            return []
        seen.silence_told = True
        if packets == 0:
            return [
                f"{self._name}: nothing of ArduSub's has come to UDP port {self._port} yet: start it with "
                "--model JSON:127.0.0.1, or give its port: --port"
            ]
        return [f"{self._name}: ArduSub has been silent for {SILENT_S:g} s; the water waits"]

    def _episode(self, instance: Instance) -> list[str]:
        seen, found = self._seen, []
        if seen.held and not instance.is_held:
            found.append(f"{self._name}: a thruster turns, the episode begins")
        if instance.outcome and not seen.outcome:
            found.append(f"{self._name}: {instance.outcome} after {instance.driven_s:.1f} s")
        seen.held, seen.outcome = instance.is_held, instance.outcome
        return found
