"""Transfer: the matrix by hand."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.statistics import bootstrap_ratio
from learning.evaluation import Evaluation, Protocol, open_subject
from learning.evaluation.files import write_transfer
from learning.evaluation.transfer import Trained, transfer

ROTATION = {
    ("igm", "cube"): [2.0, 4.0, 6.0], ("igm", "sphere"): [1.0, 1.0, 2.0],
    ("igm", "cylinder"): [6.0, 6.0, 6.0],
    ("hold", "cube"): [0.5, 1.0, 0.5], ("hold", "sphere"): [0.0, 0.0, 0.0],
    ("hold", "cylinder"): [0.1, 0.2, 0.3],
}  # fmt: skip


@pytest.fixture
def policies() -> list[Trained]:
    return [Trained(open_subject("igm"), "cube"), Trained(open_subject("hold"), "sphere")]


def run(who: Any, protocol=None, *, object=None, progress=None) -> Evaluation:  # noqa: A002
    name = str(object)
    rotation = np.array(ROTATION[who.name, name])
    none = np.zeros(3, bool)
    return Evaluation(
        object=name,
        protocol=protocol or Protocol(),
        rotation=rotation,
        time_held=np.ones(3),
        dropped=none,
        strayed=none,
        time_near=np.ones(3),
        diverged=none,
        goals_reached=np.zeros(len(rotation), int),
        goals_missed=np.zeros(len(rotation), int),
        goals_in_a_row=np.zeros(len(rotation), int),
        first_goal_time=np.full(len(rotation), np.inf),
        returns=10 * rotation,
        fingertips_only=np.ones(3),
        drift=np.zeros(3),
        mean_drift=np.zeros(3),
        sink=np.zeros(3),
        moments=np.zeros(0),
        rotations=np.zeros((0, 3)),
    )


def test_the_matrix_by_hand(policies: list[Trained], tmp_path: Path) -> None:
    found = transfer(policies, Protocol(episodes=3), ("cylinder", "cube"), run=run)
    assert found.objects == ("cube", "sphere", "cylinder")
    assert found.raw(0, 0).value == 4.0
    own, other = found.score(0, 0), found.score(0, 1)
    assert own is not None and own[:3] == (1.0, 1.0, 1.0)
    assert other is not None and other.value == 0.25  # 1 / 4
    assert 1 / 6 <= other.low <= 0.25 <= other.high <= 1.0
    by_return = found.score(0, 1, "return")
    assert by_return is not None and by_return.value == pytest.approx((4 / 3) / 4)
    # the policy of the sphere does not turn the sphere, so that its scores say nothing
    assert [found.score(1, j) for j in range(3)] == [None, None, None]
    described = json.loads(json.dumps(found.to_dict()))
    assert described["policies"][1] == {"name": "hold", "object": "sphere"}
    assert described["rotation_score"][0][2]["value"] == 1.5
    assert described["rotation_score"][1] == [None, None, None]
    assert described["rotation_median_rad"][1][0]["value"] == 0.5
    write_transfer(tmp_path / "transfer.csv", found)
    rows = list(csv.DictReader((tmp_path / "transfer.csv").open()))
    assert len(rows) == 6
    assert (rows[1]["trained_on"], rows[1]["object"]) == ("cube", "sphere")
    assert float(rows[1]["rotation_score"]) == 0.25
    assert rows[3]["rotation_score"] == ""


def test_a_ratio_of_medians() -> None:
    exact = bootstrap_ratio([3.0, 3.0], [2.0, 2.0, 2.0])
    assert exact is not None and exact == (1.5, 1.5, 1.5, 2)
    assert bootstrap_ratio([1.0], [0.0, 0.0]) is None
    assert bootstrap_ratio([1.0], [-1.0]) is None
    unsure = bootstrap_ratio([1.0, 2.0], [-1.0, 1.0, 1.0])
    assert unsure is not None and unsure.value == 1.5
    assert np.isnan(unsure.low) and np.isnan(unsure.high)
    rng = np.random.default_rng(0)
    sure = bootstrap_ratio(rng.normal(2.0, 0.1, 400), rng.normal(1.0, 0.1, 400), "mean")
    assert sure is not None and sure.low < 2.0 < sure.high and sure.high - sure.low < 0.06


def test_one_policy_per_object(policies: list[Trained]) -> None:
    with pytest.raises(InvalidInput, match="got 1 policies for a transfer matrix"):
        transfer(policies[:1], run=run)
    again = policies[1]._replace(object="cube")
    with pytest.raises(InvalidInput, match="igm and hold are both for 'cube'; expected one"):
        transfer([policies[0], again], run=run)
