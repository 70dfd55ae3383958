"""`python -P -m bridged` is can-bridge. Without -P, modules in the current directory come before ours."""

import sys

from bridged.cli import main

sys.exit(main())
