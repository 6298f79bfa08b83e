"""Configurations: fields, defaults, copies, missing values, overrides."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from robotbrain.errors import InputError
from robotbrain.rl.configclass import MISSING, Config, configclass
from robotbrain.rl.managers import ObservationGroupCfg, RewardTermCfg


def a_function() -> int:
    return 3


@configclass
class Inner:
    gains: dict[str, float] = {}  # noqa: RUF012  (configclass copies it)
    limits = [1.0, 2.0]  # noqa: RUF012


@configclass
class Outer:
    name: str = MISSING
    inner: Inner = Inner()
    count = 3
    kind: type = int
    function: Any = a_function

    def method(self) -> int:
        return self.count

    @property
    def double(self) -> int:
        return 2 * self.count

    @configclass
    class NestedCfg:
        depth: int = 1

    nested: NestedCfg = NestedCfg()


@configclass
class Derived(Outer):
    count = 5
    extra: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()  # type: ignore[misc]
        self.extra *= 2


def test_fields_are_those_of_the_body_in_order() -> None:
    names = [f.name for f in dataclasses.fields(Outer)]
    assert names == ["name", "inner", "count", "kind", "function", "nested"]
    assert [f.name for f in dataclasses.fields(Derived)] == [*names, "extra"]
    outer = Outer(name="x")
    assert outer.method() == 3 and outer.double == 6 and outer.function() == 3 and outer.kind is int


def test_annotated_names_without_value_keep_their_place() -> None:
    @configclass
    class Mixed:
        first = 1
        second: int
        third = 3

    # between un-annotated members only the annotations tell an order; a bare one comes first after those before it
    assert {f.name for f in dataclasses.fields(Mixed)} == {"first", "second", "third"}
    assert Mixed().second is MISSING


def test_defaults_are_copied_for_each_instance() -> None:
    one, two = Outer(name="1"), Outer(name="2")
    one.inner.gains["p"] = 1.0
    one.inner.limits.append(3.0)
    one.nested.depth = 7
    assert two.inner.gains == {} and two.inner.limits == [1.0, 2.0] and two.nested.depth == 1


def test_inheritance_changes_defaults_and_runs_post_init() -> None:
    derived = Derived(name="d")
    assert derived.count == 5 and derived.extra == 1.0 and derived.method() == 5


def test_missing_values_are_named_with_their_path() -> None:
    @configclass
    class Rewards:
        alive = RewardTermCfg(func=a_function)

    @configclass
    class Task:
        rewards: Rewards = Rewards()
        table = {"a": MISSING}  # noqa: RUF012

    with pytest.raises(InputError) as caught:
        Task().validate()
    assert "Task.rewards.alive.weight" in str(caught.value) and "Task.table['a']" in str(caught.value)
    Outer(name="x").validate()


def test_to_dict_is_plain_and_from_dict_overrides() -> None:
    outer = Outer(name="x")
    plain = outer.to_dict()
    assert plain["inner"] == {"gains": {}, "limits": [1.0, 2.0]}
    assert plain["function"].endswith("test_configclass:a_function") and plain["kind"] == "builtins:int"
    outer.from_dict({"count": 9, "inner.gains": {"p": 2.0}, "nested": {"depth": 4}})
    assert (outer.count, outer.inner.gains, outer.nested.depth) == (9, {"p": 2.0}, 4)


def test_unknown_fields_get_a_proposal() -> None:
    with pytest.raises(InputError, match="Did you mean 'count'"):
        Outer(name="x").from_dict({"cuont": 1})
    with pytest.raises(InputError, match="Did you mean 'depth'"):
        Outer(name="x").from_dict({"nested.dept": 1})
    with pytest.raises(InputError, match="Did you mean 'weight'"):
        RewardTermCfg(func=a_function, weight=1.0).replace(wieght=2.0)


def test_replace_and_copy_leave_the_original_alone() -> None:
    outer = Outer(name="x")
    other = outer.replace(count=4)
    other.inner.limits.append(9.0)
    same = outer.copy()
    same.nested.depth = 5
    assert other.count == 4 and outer.count == 3 and outer.inner.limits == [1.0, 2.0] and outer.nested.depth == 1


def test_group_settings_are_not_lost_by_subclasses() -> None:
    @configclass
    class PolicyCfg(ObservationGroupCfg):
        def __post_init__(self) -> None:
            super().__post_init__()
            self.enable_corruption = True

    assert PolicyCfg().enable_corruption and isinstance(PolicyCfg(), Config)
