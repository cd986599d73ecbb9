"""What is sent of an object, and its name."""

from __future__ import annotations

import importlib
import os
import pickle
import subprocess
import sys
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.cluster.serialization import SerializedObject, TransientCache, content_hash
from harnack.gallery import SCENES
from harnack.geometry import example_curves

POINTS = np.random.default_rng(0).normal(size=(20, 3))


class Counted:
    """Something that remembers what it computes."""

    def __init__(self, number: Any) -> None:
        self.number = number
        self.kept: TransientCache[str, int] = TransientCache()

    @cached_property
    def twice(self) -> Any:
        return 2 * self.number


def test_what_was_computed_is_not_sent_and_changes_no_name() -> None:
    one = Counted(3)
    before = SerializedObject.serialize(one, "test")
    assert one.twice == 6
    one.kept["a"] = 1
    after = SerializedObject.serialize(one, "test")
    assert after == before
    there = after.deserialize()
    assert "twice" not in vars(there)
    assert there.kept == {}
    assert there.twice == 6
    assert after.deserialize() is there


def test_names_tell_objects_apart() -> None:
    names = {content_hash(one, "test") for one in (1, 1.0, "1", [1], (1,), None, True, Counted(1))}
    assert len(names) == 8
    assert content_hash(Counted(np.zeros(3)), "test") != content_hash(
        Counted(np.zeros(3, np.float32)), "test"
    )


def test_names_do_not_depend_on_which_equal_objects_are_the_same() -> None:
    array = np.arange(3.0)
    assert content_hash([array, array], "test") == content_hash([array, array.copy()], "test")


@pytest.mark.parametrize("name", ["trefoil", "cloud", "soup", "helix", "letters", "gyroid", "lava"])
def test_surfaces_keep_their_names_when_they_are_used(name: str) -> None:
    fresh, used = SCENES[name].surfaces(), SCENES[name].surfaces()
    for surface in used:
        hk.trace(surface.replace(side="surface"), POINTS * 3, -POINTS)
    packed = SerializedObject.serialize(fresh, "test")
    assert SerializedObject.serialize(used, "test") == packed
    for sent, own in zip(packed.deserialize(), fresh, strict=True):
        np.testing.assert_array_equal(sent.field.value(POINTS), own.field.value(POINTS))


def test_functions_of_formulas_are_sent_by_name() -> None:
    for function in (hk.math.exp, hk.math.sin, hk.math.cos):
        assert pickle.loads(pickle.dumps(function)) is function


def test_functions_that_name_modules_are_sent() -> None:
    there = SerializedObject.serialize(
        lambda r: hk.Sphere(r).value(np.zeros((1, 3))), "test"
    ).deserialize()
    assert there(2.0) == -2


def test_what_cannot_be_sent_is_refused_by_name() -> None:
    with pytest.raises(TypeError, match=r"^client: it cannot be sent.*generator"):
        SerializedObject.serialize((k for k in range(3)), "client")


def test_moved_clouds_take_their_tree_with_them() -> None:
    """The shape of a tree decides about the last bits."""
    cloud = SCENES["cloud"].surfaces()[0].field
    assert isinstance(cloud, hk.DipolePotential)
    cloud.value(POINTS)
    moved = cloud.with_points(cloud.points * [1, 1, 3], cloud.normals, cloud.areas)
    there = SerializedObject.serialize(moved, "test").deserialize()
    np.testing.assert_array_equal(moved.value(POINTS), there.value(POINTS))


def test_curves_are_small() -> None:
    assert (
        len(SerializedObject.serialize(hk.SolidAngle(example_curves.wavy_polygon(24)), "test").data)
        < 3000
    )


PROGRAM = """
from typing import Generic, TypeVar
import constants
import harnack as hk
from harnack.cluster.serialization import content_hash

class Doubled(hk.Sphere):
    names = frozenset(["one", "two", "three"])

    def value(self, *points, **settings):
        return 2 * super().value(*points, **settings)

    def another(self):
        return Doubled(constants.radius())

T = TypeVar("T")
class Kept(Generic[T]):
    pass

factor = 3.0
def helper(x):
    return factor * x if x in {"a", "b", "c"} else helper(x)
print(content_hash([Doubled(1.0), Kept[int](), lambda x: helper(x), {"a", "b", "c"}], "test"))
"""


def test_programs_find_what_they_did_when_they_are_started_again(tmp_path: Path) -> None:
    """Also with a comment more, which moves all lines, and with modules that hold more. With
    another constant in a module a program finds nothing of it."""
    said: list[str] = []
    for k, (more, radius) in enumerate((("", 3), ("# more\n", 3), ("", 4))):
        (tmp_path / "program.py").write_text(more + PROGRAM)
        (tmp_path / "constants.py").write_text(
            "import time\n"
            f"RADIUS, began = {radius}, time.time()\n"
            "def radius():\n    return RADIUS\n"
        )
        given = [sys.executable, str(tmp_path / "program.py")]
        # A compiled module would count as up to date: the other is as long and of one second.
        env = {**os.environ, "PYTHONHASHSEED": str(k), "PYTHONDONTWRITEBYTECODE": "1"}
        said.append(subprocess.run(given, env=env, capture_output=True, check=True).stdout.decode())
    assert said[0] == said[1] != said[2]


def test_modules_of_users_are_sent_as_they_are_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker may not have them, or as they were before they were changed. What they use may have
    a lock."""
    text = """from functools import cached_property
import harnack as hk
class Mine(hk.Sphere):
    @cached_property
    def factor(self):
        return 2.0
    def value(self, *points, **settings):
        return self.factor * super().value(*points, **settings)
"""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    names: list[str] = []
    for factor in (2.0, 30.0):
        (tmp_path / "of_a_user.py").write_text(text.replace("2.0", str(factor)))
        packed = SerializedObject.serialize(importlib.import_module("of_a_user").Mine(1.0), "test")
        names.append(packed.content_hash)
        del sys.modules["of_a_user"]
        (tmp_path / "of_a_user.py").unlink()
        importlib.invalidate_caches()
        there = packed.deserialize()
        assert there.value(np.zeros((1, 3))) == -factor
        assert there.factor is there.factor
    assert names[0] != names[1]


@pytest.fixture
def own_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A module of a user that another one and a package, without a file of its own, lead to."""
    (tmp_path / "own_settings.py").write_text(
        "import functools, threading, own_paths\n"
        "LOCK, RADIUS = threading.Lock(), 1.0\n"
        "def radius():\n    return own_paths.around()\n"
        "@functools.cache\ndef kept():\n    return RADIUS\n"
        "class Own:\n    def radius(self):\n        return RADIUS\n"
    )
    (tmp_path / "own_paths.py").write_text(
        "import own_settings\ndef around():\n    return own_settings.RADIUS\n"
    )
    (tmp_path / "own_package").mkdir()
    (tmp_path / "own_package" / "part.py").write_text("import own_settings as settings\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield importlib.import_module("own_package.part")
    for name in ("own_settings", "own_paths", "own_package.part", "own_package"):
        sys.modules.pop(name, None)


def test_modules_that_functions_name_are_sent_as_they_are_here(own_modules: Any) -> None:
    """What they hold, by whichever way it is reached, and not what nobody names: a lock."""
    package, settings = sys.modules["own_package"], own_modules.settings
    ways: dict[str, Any] = {
        "attribute": lambda: settings.RADIUS,
        "function": lambda: settings.radius(),
        "class": lambda: settings.Own().radius(),
        "kept": lambda: settings.kept(),
        "package": lambda: package.part.settings.RADIUS,
        "argument": lambda module=settings: module.RADIUS,
        "in a set": lambda functions=frozenset([lambda: settings.RADIUS]): max(
            function() for function in functions
        ),
    }
    for name, way in ways.items():
        settings.RADIUS = 1.0
        before = SerializedObject.serialize(way, name)
        settings.RADIUS = 2.0
        settings.kept.cache_clear()
        after = SerializedObject.serialize(way, name)
        assert before.content_hash != after.content_hash, name
        settings.RADIUS = 3.0
        assert (before.deserialize()(), after.deserialize()()) == (1, 2), name


def test_what_is_not_seen_of_modules_is_refused(own_modules: Any) -> None:
    def within() -> Any:
        import own_settings  # pyright: ignore[reportMissingImports]

        return own_settings.RADIUS  # pyright: ignore[reportUnknownVariableType]

    with pytest.raises(TypeError, match=r"within .* imports your module own_settings when it is "):
        SerializedObject.serialize(within, "test")

    def by_name(name: str) -> Any:
        return getattr(own_modules.settings, name, None)

    there = SerializedObject.serialize(by_name, "test").deserialize()
    assert there("NEVER") is None
    with pytest.raises(RuntimeError, match=r"RADIUS of your module own_settings was not sent"):
        there("RADIUS")


factor = 2.0


class Scaled:
    def factor(self) -> float:
        return factor


def test_opening_leaves_the_classes_of_this_process_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their methods were replaced by those that were sent, for which constants never change."""
    here = Scaled()
    there = SerializedObject.serialize(here, "test").deserialize()
    monkeypatch.setattr(sys.modules[__name__], "factor", 5.0)
    assert (here.factor(), there.factor()) == (5, 2)


def test_installed_packages_count_by_their_versions() -> None:
    scipy = importlib.import_module("scipy")
    packed = SerializedObject.serialize(lambda: scipy.special.j0(1.0), "test")
    assert packed.other_versions == (("scipy", scipy.__version__),)
    with pytest.raises(RuntimeError, match=r"sent by harnack .*scipy 0\.1, and here is .*scipy 1"):
        replace(packed, other_versions=(("scipy", "0.1"),)).deserialize()


def test_files_count_by_what_is_in_them(tmp_path: Path) -> None:
    file, scan = tmp_path / "wood.png", tmp_path / "wood"
    for described in ({"type": "bitmap", "filename": str(file)}, [file], Counted(str(scan))):
        file = scan if isinstance(described, Counted) else file
        file.write_bytes(b"brown")
        packed = SerializedObject.serialize(described, "test")
        assert isinstance(described, Counted) or packed.deserialize() == described
        file.write_bytes(b"green")
        changed = SerializedObject.serialize(described, "test")
        assert changed.content_hash != packed.content_hash
        missing = SerializedObject.serialize(described, "test again")
        file.unlink()
        with pytest.raises(ValueError, match=r"wood(.png)? is not here"):
            replace(missing, content_hash="0" * 32).deserialize()


def test_names_of_attributes_are_no_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    before = SerializedObject.serialize(Counted(1), "test")
    for name in ("number", "kept", "twice", "TransientCache"):
        (tmp_path / name).write_text("a log that grows")
    assert SerializedObject.serialize(Counted(1), "test") == before


def test_other_versions_open_nothing() -> None:
    with pytest.raises(RuntimeError, match=r"sent by harnack 0\.0, and here is harnack .*drjit"):
        replace(SerializedObject.serialize(3, "test"), package_versions="harnack 0.0").deserialize()


def test_what_users_do_not_compare_is_sent() -> None:
    @dataclass(frozen=True)
    class Named:
        radius: float = field(default=1.0, compare=False)

    assert SerializedObject.serialize(Named(2.0), "test").deserialize().radius == 2
    assert content_hash(Named(2.0), "test") != content_hash(Named(3.0), "test")
