"""Which files make up a bag."""

from pathlib import Path

import yaml

from symbid_ros.errors import BagError


def bag_files(bag: Path) -> list[Path]:
    """Return the MCAP files of a bag: a folder's in recorded order, or the file itself."""
    if bag.is_file():
        return [bag]
    if not bag.is_dir():
        raise BagError(f"{bag}: no such bag; give a bag's folder or an .mcap file")
    metadata = bag / "metadata.yaml"
    if metadata.is_file():
        files = [bag / name for name in _listed_files(metadata)]
    else:
        files = sorted(bag.glob("*.mcap"), key=lambda file: (len(file.name), file.name))
    if not files:
        raise BagError(f"{bag}: not a bag, it holds no .mcap file; give the folder of a recording")
    for file in files:
        if file.suffix != ".mcap":
            raise BagError(f"{file}: not an MCAP file; convert the bag to MCAP storage")
        if not file.is_file():
            raise BagError(f"{file}: no such file, though {metadata} lists it; restore it")
    return files


def _listed_files(metadata: Path) -> list[str]:
    try:
        content = yaml.safe_load(metadata.read_text(encoding="utf-8"))
        names = content["rosbag2_bagfile_information"]["relative_file_paths"]
        listed = [Path(str(name)) for name in names]
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError) as error:
        raise BagError(
            f"{metadata}: not a rosbag2 metadata file; give the .mcap file instead"
        ) from error
    for name in listed:
        if name.name != str(name):
            raise BagError(
                f"{metadata}: lists {name}, outside the bag; give the .mcap file instead"
            )
    return [name.name for name in listed]
