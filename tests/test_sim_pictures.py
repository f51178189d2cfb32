"""Pictures of worlds and scenarios through the command line; they are looked at by people, here only measured."""

from __future__ import annotations

import ctypes.util
import json

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from sim_backend import world as worlds
from sim_backend.view_heights import CUT_Z, ViewHeights
from sim_backend.world_cli import world

needs_opengl = pytest.mark.skipif(ctypes.util.find_library("EGL") is None, reason="no libEGL to render with")


def run(*arguments):
    return CliRunner().invoke(world, [str(argument) for argument in arguments])


@needs_opengl
@pytest.mark.parametrize("name", ["flooded", "tunnel"])
def test_a_picture_shows_robot_and_world(tmp_path, name):
    file = tmp_path / "picture.png"
    result = run(name, "--at", 4, "--picture", file)
    assert result.exit_code == 0, result.output
    rgb = np.asarray(Image.open(file).convert("RGB")).astype(int)
    assert rgb.shape[1] == 1500
    scene = rgb[: int(0.8 * len(rgb)), : rgb.shape[1] // 2]
    # Ground is grey or sand, rods run from violet to yellow, the body is a bluish glass, the sky is white.
    colourful = np.ptp(scene, axis=-1) > 60
    grey = (np.ptp(scene, axis=-1) < 40) & (scene.max(axis=-1) < 245)
    assert colourful.mean() > 0.004
    assert grey.mean() > 0.1
    # The map on the right is not one colour either.
    assert np.unique(rgb[:, rgb.shape[1] // 2 :].reshape(-1, 3), axis=0).shape[0] > 200


@needs_opengl
def test_an_animation_moves(tmp_path):
    from sim_backend import world_picture

    file = tmp_path / "drive.gif"
    scene = worlds.load("flat")
    world_picture.write_animation(scene, 1, "quasi-static", file, frames=3, width=400)
    animation = Image.open(file)
    assert animation.n_frames == 3
    first = np.asarray(animation.convert("RGB")).astype(int)
    animation.seek(2)
    assert np.abs(np.asarray(animation.convert("RGB")).astype(int) - first).max() > 100


def test_galleries_are_cut_open():
    heights = ViewHeights.of(worlds.load("tunnel"), ((-1.0, 2.0), (-1.0, 1.0)), 100)
    assert heights.rock.any()
    assert not heights.rock.all()
    assert (heights.z[heights.rock] == CUT_Z).all()
    assert heights.z[~heights.rock].max() < CUT_Z


def test_figures_of_a_world():
    figures = json.loads(run("mine", "--json").output)
    assert figures["layout"] == "rm3"
    assert figures["scenarios"]["2"]["length_m"] > 300


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("nowhere",), "no world is called"),
        (("flat", "--scenario", 9, "--picture", "x.png"), "no scenario 9"),
        (("flat", "--at", 1e6, "--picture", "x.png"), "lasts from 0 to"),
        (("flat", "--picture", "x.jpg"), "expected a file that ends in .png"),
    ],
)
def test_mistakes_get_one_clear_line(arguments, said):
    result = run(*arguments)
    assert result.exit_code == 2
    assert said in result.output.splitlines()[-1]
