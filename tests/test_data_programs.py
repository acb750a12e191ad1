"""Numbers of the data programs that have no other test of theirs."""

import pytest

from data_pipelines.inspect.__main__ import Options as InspectOptions
from data_pipelines.oxe.__main__ import fixtures, prepare
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.errors import UserError
from dsvla_jax.perception.grounding import GroundingOptions


def test_numbers_of_the_other_data_programs_have_their_range(tmp_path):
    for wrong in ({"episodes": 0}, {"episodes": -3}, {"steps": 1}):
        with pytest.raises(UserError, match=f"{next(iter(wrong))}: expected at least"):
            fixtures(tmp_path / "new", ("viola",), **wrong)
    with pytest.raises(UserError, match="seed: expected at least 0, got -1"):
        prepare(OxeConfig(folder=str(tmp_path), mixture=("viola",)), seed=-1)
    with pytest.raises(UserError, match="episodes: expected at least 1, got -3"):
        InspectOptions(path=str(tmp_path), episodes=-3)
    with pytest.raises(UserError, match="box_threshold: expected at least 0, at most 1"):
        GroundingOptions(box_threshold=-0.1)
    assert not (tmp_path / "new").exists()
