"""A cold run: a store with nothing in it, so that a run computes all that it needs, as the first one does."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from neusee.workflows.store.result_store import Store


@contextmanager
def cold(store: Store) -> Iterator[Store]:
    """Yield an empty store and delete it afterwards. It keeps the digests of code, which a first run reads too."""
    with TemporaryDirectory(prefix="neusee-") as folder:
        if os.path.isfile(store.code_memo):
            shutil.copyfile(store.code_memo, Path(folder) / store.code_memo.name)
        yield Store(folder)
