"""What the documents promise is what the code has."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from unghost import cli
from unghost.core.channels import CHANNEL_NAMES
from unghost.core.manifest import FORMAT, METADATA_KEY, Manifest
from unghost.core.shards.packing import unpack_labels
from unghost.core.shards.storage import ARRAYS, read_shard
from unghost.core.shards.storage import FORMAT as SHARD_FORMAT
from unghost.evaluation.scoring.conventions import CONVENTIONS, PLAIN_CONVENTIONS

ROOT = Path(__file__).resolve().parents[2]
FORMATS = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")


def test_every_key_of_the_formats_is_documented():
    words = [item.name for item in dataclasses.fields(Manifest)] + list(CHANNEL_NAMES) + [FORMAT, METADATA_KEY]
    words += [f"{name}.npy" for name in ARRAYS] + [SHARD_FORMAT]
    assert [word for word in words if not re.search(rf"[`\"]{re.escape(word)}[`\"]", FORMATS)] == []


@pytest.mark.parametrize(
    "name",
    ["README.md", "CHANGELOG.md", "docs/conventions.md", "docs/formats.md", "docs/prior.md", "docs/evaluation.md"],
)
def test_links_between_documents_lead_somewhere(name):
    path = ROOT / name
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text(encoding="utf-8")):
        if not target.startswith("https://"):
            assert (path.parent / target).exists(), target


def test_every_verb_is_in_the_readme(capsys):
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    verbs = re.search(r"\{([a-z,]+)\}", capsys.readouterr().out).group(1).split(",")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [verb for verb in verbs if f"`unghost {verb}" not in readme] == []


def test_the_sample_of_the_harvest_is_whole_small_and_ours():
    folder = ROOT / "docs" / "harvest" / "sample"
    shard = read_shard(folder, verify=True)
    assert len(set(shard.group.tolist())) == len(shard) == 8
    assert {scene["field"] for scene in shard.provenance["scenes"]} == {"dense", "hash"}
    assert shard.kind == json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["kind"] == "harvest"
    assert shard.provenance["licence"] == "generated"
    for name in ("surroundings", "view_count", "transmittance", "frames"):
        assert getattr(shard, name) is not None, name
    assert set(np.unique(unpack_labels(shard.labels))) == {0, 1, 2}
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 700_000


def test_every_convention_is_in_the_document():
    text = (ROOT / "docs" / "evaluation.md").read_text(encoding="utf-8")
    assert [name for name in (*CONVENTIONS, *PLAIN_CONVENTIONS) if f"| `{name}`" not in text] == []
