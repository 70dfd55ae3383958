"""python -m bridged is can-bridge."""

import sys

from bridged.cli import main

sys.exit(main())
