"""Pages by workers, and the options of the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.cli import main
from harnack.rendering import register


@pytest.mark.slow
def test_pages_are_the_same(client: Any, tmp_path: Path) -> None:
    one, two = tmp_path / "a.html", tmp_path / "b.html"
    settings: dict[str, Any] = {"r": hk.Slider(0.5, 1.0, step=0.1), "progress": False}

    def ball(r: float) -> hk.Field:
        return hk.Torus(1.0, 0.5 * r)

    hk.page(ball, one, **settings)
    hk.page(ball, two, client=client, checkpoint=tmp_path / "parts", **settings)
    assert one.read_bytes() == two.read_bytes()
    assert len(list((tmp_path / "parts").iterdir())) == 6


def test_commands_take_a_cluster(
    cluster: Any, client: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = ["gyroid", "--size", "24x18", "--quiet"]
    there = ["--client", cluster.scheduler_address, "--checkpoint", str(tmp_path / "parts")]
    pictures = [tmp_path / "a.png", tmp_path / "b.png"]
    shaded = ["--show", "shaded"]
    assert main(["render", *small, *shaded, "-o", str(pictures[0])]) == 0
    assert main(["render", *small, *shaded, "-o", str(pictures[1]), "--chunks", "3", *there]) == 0
    mi = register()
    alone, by_workers = (np.array(mi.Bitmap(str(path))) for path in pictures)
    np.testing.assert_array_equal(alone, by_workers)
    film = ["animate", *small, "--frames", "2", "-o", str(tmp_path / "a.gif"), *there]
    assert main(film) == 0
    assert len(list((tmp_path / "parts").iterdir())) > 4
    assert main(["render", *small, "-o", str(pictures[0]), "--chunks", "3"]) == 1
    assert "--chunks: parts are drawn one by one" in capsys.readouterr().err
