"""python -m backlash_ros.tools.identify"""

import sys

from backlash_ros.tools.identify.command import main

sys.exit(main())
