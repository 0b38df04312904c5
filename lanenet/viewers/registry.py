"""All viewers: adding one means a module with its ``KIND``, and its line here."""

from __future__ import annotations

from lanenet.viewers import mcap_file, rerun_viewer
from lanenet.viewers.viewer import ViewerKind

VIEWERS: dict[str, ViewerKind] = {kind.name: kind for kind in (rerun_viewer.KIND, mcap_file.KIND)}
