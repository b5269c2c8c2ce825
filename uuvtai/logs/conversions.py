"""Which conversion ``uuv log convert`` is asked for."""

from __future__ import annotations

from pathlib import Path

from uuvtai.logs.log_errors import LogError

TARGETS, SOURCES = ("protobuf", "rosbag2"), ("mcap", "rosbag2")


def converted(file: Path, out: Path | None, to: str, source: str, force: bool) -> tuple[Path, int]:
    """(what was written, how many messages). Raises LogError, FileError."""
    if to not in TARGETS:
        raise LogError(f"--to {to}: choose one of {', '.join(TARGETS)}")
    if source not in SOURCES:
        raise LogError(f"--from {source}: choose one of {', '.join(SOURCES)}")
    if source == to:
        raise LogError("--from rosbag2 --to rosbag2: a bag becomes a log; leave out --to")
    if source == "rosbag2":
        from uuvtai.logs.rosbag import from_rosbag2

        target = out or file.with_name(f"{file.stem}.log.mcap")
        return target, from_rosbag2(file, target, force)
    if to == "rosbag2":
        from uuvtai.logs.rosbag import to_rosbag2

        target = out or file.with_name(f"{file.stem}_rosbag2")
        return target, to_rosbag2(file, target, force)
    from uuvtai.logs.convert import convert

    target = out or file.with_suffix(".protobuf.mcap")
    return target, convert(file, target, force)
