"""`python -m dnnmso_mj` is the command `dnnmso`."""

from __future__ import annotations

import sys
from typing import NoReturn


def main() -> NoReturn:
    """Entry point; Ctrl-C while the command line itself is loaded is one line too."""
    try:
        from dnnmso_mj.cli import main as command

        command()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
