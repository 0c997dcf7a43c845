import numpy as np
import pytest
from tests.vehicle.sim.rig import MODEL, pose_at

from lavt.vehicle.sim.rendering.light import LIGHTS
from lavt.vehicle.sim.rendering.pinhole import place_camera
from lavt.vehicle.sim.rendering.roadside_objects import place_roadside_objects
from lavt.vehicle.sim.rendering.scenery import Scenery
from lavt.vehicle.sim.road.road import load_road


def test_the_windows_of_a_wall_are_on_this_wall() -> None:
    """Each visible wall is drawn with its own number of windows, all of them within its outline."""
    road = load_road("a_key")
    objects = place_roadside_objects(road, full_scenery=True)
    scenery = Scenery(objects, LIGHTS["noon"])
    counts = {len(windows_m) for windows_m in objects.walls.windows_m}
    drawn = 0
    for s_m in (0.0, 40.0, 80.0, 120.0):
        for _, _, (outline, windows), _ in scenery._wall_drawings(place_camera(MODEL, pose_at(road, s_m))):
            drawn += 1
            corners = np.concatenate(windows)
            assert len(windows) in counts
            assert (corners >= outline.min(axis=0)).all()
            assert (corners <= outline.max(axis=0)).all()
    assert drawn > 4


@pytest.mark.parametrize("turned_rad", [0.0, 0.7])
def test_only_objects_across_the_picture_are_drawn(turned_rad: float) -> None:
    """Each face that is drawn reaches columns of the picture, and its depth is at most the farthest."""
    road = load_road("a_key")
    scenery = Scenery(place_roadside_objects(road, full_scenery=True), LIGHTS["noon"])
    placement = place_camera(MODEL, pose_at(road, 40.0, turned_rad=turned_rad))
    drawings = list(scenery._face_drawings(placement))
    assert len(drawings) > 20
    for depth_m, _, outline, _ in drawings:
        assert 0.4 <= depth_m < 170
        assert outline[:, 0].max() > 0
        assert outline[:, 0].min() < 640 * 16
