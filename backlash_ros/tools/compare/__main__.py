"""python -m backlash_ros.tools.compare"""

import sys

from backlash_ros.tools.compare.command import main

sys.exit(main())
