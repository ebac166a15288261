"""Run the command line: python -m lyceum_warp.cli."""

import sys

from lyceum_warp.cli import main

sys.exit(main())
