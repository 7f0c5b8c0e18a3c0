"""``python -m smartcam``: the command ``smartcam``."""

from smartcam._cli import main

if __name__ == "__main__":
    main()
