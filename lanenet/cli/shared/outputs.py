"""Checks of output paths, before the work starts."""

from __future__ import annotations

from pathlib import Path

from lanenet.errors import ConfigError

#: What the simulator puts into a drive's folder.
_BESIDE_FRAMES = ("track.json", "simulation.yaml")


def check_ending(path: Path, *endings: str) -> None:
    """Refuse an output whose ending is not one of its format.

    Raises:
        ConfigError: Names the endings.
    """
    if path.suffix.lower() not in endings:
        raise ConfigError(f"{path}: expected a name that ends in {' or '.join(endings)}")


def check_not_source(source: Path, *outs: Path | None) -> None:
    """Refuse an output that would replace a file of the source, or be read as part of it next time.

    Args:
        source: Photo, video, folder of photos, drive, tub, map or label set.
        outs: Files to write; None for none.

    Raises:
        ConfigError: Names the output and the source.
    """
    for out in outs:
        if out is not None and _belongs_to(source, source.resolve(), out.resolve()):
            raise ConfigError(
                f"{out}: is a file of {source}, which this command reads, or would be taken for one; choose "
                "another name"
            )


def _belongs_to(source: Path, resolved: Path, out: Path) -> bool:
    # Imported here: commands that read no drive need not wait for OpenCV.
    from lanenet.data.drives.folder import DRIVE_FILE, FRAMES_FILE, TRUTH_FILE
    from lanenet.data.drives.sources import PHOTO_ENDINGS
    from lanenet.data.drives.tub import MANIFEST_FILE

    if not resolved.is_dir():
        # Beside a video lie its times and commands, beside a label set its report, wherever a link leads.
        ending = source.suffix.lower()
        kinds = (".json", ".png") if ending == ".parquet" else () if ending in PHOTO_ENDINGS else (".csv",)
        folder = source.parent.resolve()
        return out == resolved or out in {folder / f"{source.stem}{kind}" for kind in kinds}
    if resolved not in out.parents:
        return False
    if (resolved / "map.yaml").is_file():
        return out.exists()
    # Not the camera: a calibration gives the drive one.
    read = (FRAMES_FILE, MANIFEST_FILE, DRIVE_FILE, TRUTH_FILE, *_BESIDE_FRAMES)
    is_drive = any((resolved / name).is_file() for name in (FRAMES_FILE, MANIFEST_FILE))
    if is_drive and out.parent == resolved and out.name.lower() in read:
        return True
    return out.exists() and out.suffix.lower() in (".catalog", ".catalog_manifest", *PHOTO_ENDINGS)
