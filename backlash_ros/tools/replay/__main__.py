"""python -m backlash_ros.tools.replay"""

import sys

from backlash_ros.tools.replay.command import main

sys.exit(main())
