"""A package with entry points, installed in a folder."""

from collections.abc import Mapping
from pathlib import Path


def write_package(
    folder: Path, package: str, groups: Mapping[str, Mapping[str, str]], files: Mapping[str, str], version: str = "1.0"
) -> None:
    """Write the files of a package and its metadata, as pip writes them."""
    metadata = folder / f"{package.replace('-', '_')}-{version}.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
    points = (
        f"[{group}]\n" + "".join(f"{name} = {row}\n" for name, row in rows.items()) for group, rows in groups.items()
    )
    (metadata / "entry_points.txt").write_text("\n".join(points))
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
