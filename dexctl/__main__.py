"""``python -m dexctl``: the same as the ``dexctl`` command."""

from __future__ import annotations

import sys

from dexctl.cli import main

if __name__ == "__main__":
    sys.exit(main())
