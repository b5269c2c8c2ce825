"""The examples of the documentation, which are installed beside the package, as a folder of one's own."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

from uuvtai.errors import UserError

_CHECKOUT = Path(__file__).parents[1] / "examples"
_SUFFIXES = (".py", ".yaml", ".xml", ".ipynb", ".parm")


class ExampleError(UserError, OSError):
    """Examples cannot be copied: what, where, why, what to type next."""


def example_files() -> list[Path]:
    """Where they lie: in the checkout, or what the wheel put into ``share/uuvtai/examples``."""
    if (_CHECKOUT / "own_astar.py").is_file():
        found = list(_CHECKOUT.iterdir())
    else:
        installed = metadata.files("uuvtai") or []
        found = [Path(str(f.locate())) for f in installed if f.parts[-3:-1] == ("uuvtai", "examples")]
    return sorted(path for path in found if path.suffix in _SUFFIXES and path.is_file())


def copy_examples(folder: Path) -> list[Path]:
    """Write them into a folder that is new or has none of them; what was written. Raises ExampleError."""
    sources = example_files()
    if not sources:
        raise ExampleError(
            "the examples are not installed here (a wheel brings them); they are in the folder examples of "
            "the source distribution: pip download --no-binary uuvtai --no-deps uuvtai"
        )
    if there := [folder / path.name for path in sources if (folder / path.name).exists()]:
        raise ExampleError(
            f"{there[0]}: is there already, and is kept; name another folder: uuv examples NEW"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for source in sources:
            (folder / source.name).write_bytes(source.read_bytes())
    except OSError as error:
        raise ExampleError(
            f"{folder}: cannot write there ({error.strerror}); name another folder: uuv examples FOLDER"
        ) from error
    return [folder / source.name for source in sources]
