"""``python -m service.cli``: the commands of the service alone."""

import sys

from service.cli.main import main

sys.exit(main())
