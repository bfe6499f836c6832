"""The digest that rows keep of what they were computed with."""

import re
import shutil
from pathlib import Path

import pytest

from daemon.slots import identity


@pytest.mark.parametrize("changed", ["core/seeing.py", "daemon/slots/measuring.py"])
def test_numerics_that_change_by_a_byte_have_another_digest(tmp_path: Path, changed: str) -> None:
    shutil.copytree(identity.ROOT / "core", tmp_path / "core")
    shutil.copytree(identity.ROOT / "daemon/slots", tmp_path / "daemon/slots")
    own = identity.code_digest(identity.NUMERICS)
    assert identity.code_digest(identity.NUMERICS, tmp_path) == own
    with (tmp_path / changed).open("a") as source:
        source.write("#")
    assert identity.code_digest(identity.NUMERICS, tmp_path) != own


def test_another_library_is_other_numerics(monkeypatch: pytest.MonkeyPatch) -> None:
    own = identity.made_by.__wrapped__()
    assert re.fullmatch(r"\d+\.\d+\.\d+\+[0-9a-f]{8}", own)
    assert identity.made_by.__wrapped__() == own == identity.made_by()
    monkeypatch.setattr(identity.np, "__version__", "1.0")
    assert identity.made_by.__wrapped__() != own
