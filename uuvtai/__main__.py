"""What ``uuv`` runs first: signals are heard and the standard streams are there before anything that takes
time is imported."""

from __future__ import annotations

from uuvtai.common import signals


def main() -> None:
    """Run the command line. What Python itself does before this line is not ours to guard."""
    signals.install()
    _fill_streams()
    signals.end_at_second()
    from uuvtai.cli import main as run

    run()


def _fill_streams() -> None:
    """Put the null device where a standard stream was closed (``>&-``): else the next file opened would get
    its number, and its text."""
    import os
    import sys

    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))


# ------------------------------------------------------------------------------------------------------------
# ``python -m uuvtai`` is ``uuv``.


if __name__ == "__main__":  # the processes of a sweep import this file too, under another name
    main()
