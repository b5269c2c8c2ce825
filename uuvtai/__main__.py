"""``python -m uuvtai`` is ``uuv``."""

from uuvtai.cli import main

main()
