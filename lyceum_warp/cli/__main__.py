"""Run the commands of lyceum-warp with python -m lyceum_warp.cli."""

import sys

from lyceum_warp.cli import main

sys.exit(main())
