"""The examples of the documentation, which are installed beside the package, as a folder of one's own."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

from uuvtai.errors import UserError
from uuvtai.files import whole_file

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
    written: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for source in sources:
            with whole_file(folder / source.name) as (file, _):
                file.write(source.read_bytes())
            written.append(folder / source.name)
    except OSError as error:
        for path in written:
            path.unlink(missing_ok=True)
        raise ExampleError(
            f"{folder}: cannot write there ({error.strerror}); name another folder: uuv examples FOLDER"
        ) from error
    return written
