"""Files that must stay as they are while a training runs: its photographs, which are read again and again."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from neusee.workflows.keys.input_file_digest import Stamp, file_digest, file_stamps


@dataclass
class UnchangedFiles:
    """Files with the digests that their training recorded before its first iteration."""

    contents: Mapping[Path, str]
    _stamps: dict[Path, Stamp] = field(default_factory=dict)

    @classmethod
    def of(cls, paths: Iterable[Path]) -> UnchangedFiles:
        """Note the content of files."""
        return cls({path: file_digest(path) for path in paths})

    def require(self) -> None:
        """Raise ValueError if a file is gone or has another content; a file that was only touched is the same."""
        for path, content in self.contents.items():
            try:
                stamp = file_stamps(path)[0]
                if self._stamps.get(path) == stamp:
                    continue
                same = file_digest(path) == content
            except OSError as error:
                raise ValueError(self._said(path, f"cannot be read any more ({error.strerror})")) from error
            if not same:
                raise ValueError(self._said(path, "has another content now"))
            self._stamps[path] = stamp

    @staticmethod
    def _said(path: Path, what: str) -> str:
        return (
            f"the photograph {path} {what}, after this training began with it; the checkpoint before is kept: put the "
            "file back and give the command again to go on, or give the command as it is to begin anew"
        )
