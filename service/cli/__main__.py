"""``python -m dehyst.service.cli``: the commands of the service alone."""

import sys

from dehyst.service.cli.main import main

sys.exit(main())
