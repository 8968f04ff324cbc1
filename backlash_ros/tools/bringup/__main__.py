"""python -m backlash_ros.tools.bringup"""

import sys

from backlash_ros.tools.bringup.command import main

sys.exit(main())
