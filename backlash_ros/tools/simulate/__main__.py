"""python -m backlash_ros.tools.simulate"""

import sys

from backlash_ros.tools.simulate.command import main

sys.exit(main())
