"""Reports without what takes most of their time, for tests of all else; as a program, bringup."""

import sys
from typing import IO

from matplotlib.backends.backend_agg import FigureCanvasAgg

from backlash_ros.tools.bringup import __main__ as bringup

NO_PICTURE = b'\x89PNG'


def leave_out(canvas: FigureCanvasAgg, file: IO[bytes], **_: object) -> None:
    file.write(NO_PICTURE)


if __name__ == '__main__':
    FigureCanvasAgg.print_png = leave_out
    sys.exit(bringup.main())
