"""The links of ``.src/neusee``, made where a source distribution is installed for editing: an
archive holds none.
"""

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

_ROOMS = ("nodes", "workflows", "recipes")


class SourceLinks(BuildHookInterface[Any]):
    """A hook of the wheel that adds the links that an editable install reads."""

    PLUGIN_NAME = "source_links"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Make each link that is not there."""
        for room in _ROOMS if version == "editable" else ():
            link = Path(self.root, ".src", "neusee", room)
            if not link.exists():
                link.symlink_to(f"../../{room}")
