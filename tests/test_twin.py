"""The third noun: joints move points as their words say, chains compose, and the file is a contract."""

import json
from pathlib import Path

import numpy as np
import pytest

from hingesplat.errors import HingesplatError
from hingesplat.screw import prismatic, revolute
from hingesplat.twin import Joint, JointStd, JointType, Part, Twin


def joint(child: int, parent: int, type: JointType, axis: tuple[float, float, float]) -> Joint:
    pivot = (0.5, -0.2, 0.1 * child)
    return Joint(child, parent, type, axis, pivot, (0.0, 0.7), (-0.1, 1.5), JointStd(0.1, 0.002, 0.003), 0.9, "ok")


def twin() -> Twin:
    """A cabinet: door on the base, handle sliding on the door, shelf that stays."""
    return Twin(
        (
            Part(0, "base", 90),
            Part(1, "door", 40, "parts/door.glb"),
            Part(2, "latch", 7),
            Part(3, "shelf", 5),
        ),
        (
            joint(1, 0, "revolute", (0.0, 0.0, 1.0)),
            joint(2, 1, "prismatic", (1.0, 0.0, 0.0)),
            joint(3, 0, "fixed", (0.0, 0.0, 1.0)),
        ),
        "metres",
        0.5,
    )


def test_rotation_is_right_handed_about_the_axis() -> None:
    T = Joint(1, 0, "revolute", (0, 0, 1), (1, 0, 0), (0, 1), (0, 1)).transform(np.pi / 2)
    np.testing.assert_allclose(T @ [2, 0, 0, 1], [1, 1, 0, 1], atol=1e-12)


def test_joints_agree_with_screws() -> None:
    axis = (2 / 3, -1 / 3, 2 / 3)
    j = joint(1, 0, "revolute", axis)
    np.testing.assert_allclose(j.transform(0.4), revolute(axis, j.pivot, 0.4), atol=1e-12)
    np.testing.assert_allclose(joint(1, 0, "prismatic", axis).transform(0.4), prismatic(axis, 0.4), atol=1e-12)
    np.testing.assert_array_equal(joint(1, 0, "fixed", axis).transform(0.4), np.eye(4))


def test_a_part_moves_with_its_parent_and_the_first_state_is_rest() -> None:
    t = twin()
    for T in t.at_state(0).values():
        np.testing.assert_array_equal(T, np.eye(4))
    T = t.transforms({1: 0.3, 2: 0.2})
    door = revolute((0, 0, 1), t.joints[0].pivot, 0.3)
    np.testing.assert_allclose(T[1], door, atol=1e-12)
    np.testing.assert_allclose(T[2], door @ prismatic((1, 0, 0), 0.2), atol=1e-12)
    np.testing.assert_array_equal(T[0], np.eye(4))
    np.testing.assert_allclose(t.at_state(1)[1], revolute((0, 0, 1), t.joints[0].pivot, 0.7), atol=1e-12)


def test_joint_of() -> None:
    assert twin().joint_of(0) is None
    assert twin().joint_of(2) == twin().joints[1]


def test_saving_and_loading_is_exact_and_leaves_one_file(tmp_path: Path) -> None:
    twin().save(tmp_path / "twin.json")
    assert Twin.load(tmp_path / "twin.json") == twin()
    assert [p.name for p in tmp_path.iterdir()] == ["twin.json"]


def test_the_keys_of_the_file_are_the_contract(tmp_path: Path) -> None:
    twin().save(tmp_path / "twin.json")
    data = json.loads((tmp_path / "twin.json").read_text())
    assert {"version", "units", "parts", "joints"} <= data.keys()
    assert {"id", "name", "gaussians", "mesh", "splats"} <= data["parts"][0].keys()
    required = {"child", "parent", "type", "axis", "pivot", "states", "limits", "std"}
    assert required <= data["joints"][0].keys()
    assert data["joints"][0]["std"].keys() == {"axis_deg", "pivot", "motion"}


def test_files_that_are_missing_broken_or_foreign_get_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "twin.json"
    with pytest.raises(HingesplatError, match=r"twin\.json: no such file"):
        Twin.load(path)
    path.write_text('{"version": 1,\n "units"')
    with pytest.raises(HingesplatError, match=r"not valid JSON .*line 2"):
        Twin.load(path)
    data = twin().to_json()
    path.write_text(json.dumps({**data, "version": 99}))
    with pytest.raises(HingesplatError, match="version 99, this program reads 1"):
        Twin.load(path)
    del data["joints"][1]["axis"]
    path.write_text(json.dumps(data))
    with pytest.raises(HingesplatError, match="axis"):
        Twin.load(path)


FAULTS = {
    "in a ring": ([{"parent": 2}, {"parent": 1}, {}], "hangs from itself"),
    "no axis": ([{"axis": (0, 0, 0)}, {}, {}], "the joint of part 1: axis and pivot"),
    "a flat axis": ([{"axis": (0, 1)}, {}, {}], "axis and pivot"),
    "not a number": ([{"pivot": (0, float("nan"), 1)}, {}, {}], "axis and pivot"),
    "other states": ([{}, {"states": (0.0,)}, {}], "the joint of part 2: states"),
    "another type": ([{"type": "continuous"}, {}, {}], "'continuous'; use revolute, prismatic, fixed"),
    "no such parent": ([{"parent": 9}, {}, {}], "its parent, 9, is no part"),
    "two joints": ([{}, {"child": 1}, {}], "its child"),
    "limits the wrong way": ([{"limits": (1, 0)}, {}, {}], "limits"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_file_mended_by_hand_is_looked_at(name: str, tmp_path: Path) -> None:
    changes, words = FAULTS[name]
    data = twin().to_json()
    data["joints"] = [{**j, **change} for j, change in zip(data["joints"], changes, strict=True)]
    (tmp_path / "twin.json").write_text(json.dumps(data))
    with pytest.raises(HingesplatError, match=words):
        Twin.load(tmp_path / "twin.json")


def test_a_file_in_another_encoding_is_no_fault_of_the_program(tmp_path: Path) -> None:
    (tmp_path / "twin.json").write_bytes(b'{"name": "T\xfcre"}')
    with pytest.raises(HingesplatError, match="not valid JSON"):
        Twin.load(tmp_path / "twin.json")
