"""``python -m uuvtai`` is ``uuv``."""

from uuvtai.entry import main

if __name__ == "__main__":  # the processes of a sweep import this file too, under another name
    main()
