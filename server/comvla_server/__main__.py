"""``python -m comvla_server``."""

import sys

from comvla_server.cli import main

sys.exit(main())
