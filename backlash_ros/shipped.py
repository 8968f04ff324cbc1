"""Where the files are that come with the package, wherever it was installed."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

DEFAULT_CONFIG = 'paper_example.yaml'


def find_config(config: Path | None) -> Path:
    """Path of a configuration file: as given, or else among the shipped ones by name.

    None is the shipped example of the paper.
    """
    given = config or Path(DEFAULT_CONFIG)
    if config is not None and (config.exists() or config.parent != Path()):
        return config
    package = 'backlash_ros'
    # The source tree first: beside the code that runs lies the configuration written for it.
    folders = [Path(__file__).resolve().parents[1] / 'config']
    try:
        ament_index = importlib.import_module('ament_index_python.packages')
        folders.append(Path(ament_index.get_package_share_directory(package)) / 'config')
    except (ImportError, LookupError, OSError):
        pass  # no ament index here, or the package is not in it
    folders.append(Path(sys.prefix) / 'share' / package / 'config')
    found = (folder / given.name for folder in folders if (folder / given.name).exists())
    return next(found, given)
