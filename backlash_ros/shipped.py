"""Where the files are that come with the package, wherever it was installed."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

DEFAULT_CONFIG = 'paper_example.yaml'


def config_folders() -> list[Path]:
    """Folders that may hold the shipped YAML files, the best one first."""
    package = 'backlash_ros'
    # The source tree first: beside the code that runs lies the configuration written for it.
    places = [Path(__file__).resolve().parents[1] / 'config']
    try:
        ament_index = importlib.import_module('ament_index_python.packages')
        places.append(Path(ament_index.get_package_share_directory(package)) / 'config')
    except (ImportError, LookupError, OSError):
        pass  # no ament index here, or the package is not in it
    places.append(Path(sys.prefix) / 'share' / package / 'config')
    return places


def find_config(config: Path | None) -> Path:
    """Path of a configuration file: as given, or else among the shipped ones by name.

    None is the shipped example of the paper.
    """
    given = config or Path(DEFAULT_CONFIG)
    if config is None or (not config.exists() and config.parent == Path()):
        for folder in config_folders():
            if (folder / given.name).exists():
                return folder / given.name
    return given
