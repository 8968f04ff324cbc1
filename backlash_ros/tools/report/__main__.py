"""python -m backlash_ros.tools.report"""

import sys

from backlash_ros.tools.report.command import main

sys.exit(main())
