"""Write files that appear complete or not at all."""

import os
from pathlib import Path


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write content to a temporary file beside path and rename that to path."""
    temporary = _beside(path)
    try:
        with temporary.open('wb') as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            # Otherwise a power cut may leave an empty file under the new name.
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)  # a full disk names none
        raise


def point_link(link: Path, target: str) -> None:
    """Make the symbolic link point to target, replacing an older link in one step."""
    temporary = _beside(link)
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(target)
    try:
        os.replace(temporary, link)
    except OSError:  # a folder stands there
        temporary.unlink()
        raise


def _beside(path: Path) -> Path:
    return path.with_name(f'.{path.name}.{os.getpid()}')
