"""``python -m tungsten_dip`` is the command ``tungsten-dip``."""

import sys

from tungsten_dip.cli.tungsten_dip import main

sys.exit(main())
