"""The set-ups of Kahlmann 2007, chapter 3: what stands where, and the schedule of stations."""

from itertools import pairwise

import numpy as np
from scene_text import Experiment, about, pose, surface, texture

SECOND_CAMERA = "sr3000_with_second_camera"

GON = np.pi / 200
WARM = 360.0  # s: sec. 3.3.7, the SR-3000 is stable after 6 min
SETTINGS = (16, 60, 100)  # sec. 3.3.2
WHITE, BLACK = 0.85, 0.05
# a surface that has been taken away is parked behind the camera, where no ray meets it
AWAY = (0.0, 0.0, -5.0)
# pixel 71/87 (row/column), which the thesis observes: its ray x, y for z = 1, without distortion
PIXEL = ((87 - 89.9925) / 199.8875, (71 - 82.3925) / 199.8875)
# squares of 0.1 m of a board of 1.0 x 0.8 m, white ones and many greys
GREYS = [
    [0.85, 0.30, 0.85, 0.50, 0.85, 0.20, 0.85, 0.70, 0.85, 0.20],
    [0.50, 0.85, 0.12, 0.85, 0.70, 0.85, 0.06, 0.85, 0.60, 0.85],
    [0.85, 0.50, 0.85, 0.70, 0.85, 0.12, 0.85, 0.12, 0.85, 0.70],
    [0.06, 0.85, 0.50, 0.85, 0.30, 0.85, 0.40, 0.85, 0.20, 0.85],
    [0.85, 0.12, 0.85, 0.50, 0.85, 0.20, 0.85, 0.70, 0.85, 0.06],
    [0.30, 0.85, 0.60, 0.85, 0.30, 0.85, 0.60, 0.85, 0.60, 0.85],
    [0.85, 0.12, 0.85, 0.30, 0.85, 0.06, 0.85, 0.40, 0.85, 0.20],
    [0.60, 0.85, 0.40, 0.85, 0.40, 0.85, 0.06, 0.85, 0.40, 0.85],
]


def track_line():
    """Plate from 0.3 to 7.3 m every 5 cm, forth and back (sec. 3.3.8)."""
    made = Experiment(
        """
Track line (Kahlmann 2007, sec. 3.3.8): a white plate of 1 x 1 m on a trolley, perpendicular to the optical axis, 0.3 to 7.3 m away every
0.05 m, forth and back. Setting 16 below 1.05 m, where a white plate saturates at 100, setting 100 beyond, both up to 1.5 m.
Determines: cyclic_error, distance_scale, amplitude_offset, integration_time_offset of the two settings.
""",
        [surface("plate", "rectangle", sigma=(5e-5, 5e-4), size="[1.0, 1.0]", reflectivity=WHITE)],
    )
    forth = 0.3 + 0.05 * np.arange(141)
    uptime = WARM
    for z in [*forth, *forth[::-1]]:
        for setting in [s for s, low, high in ((16, 0.0, 1.52), (100, 1.03, 9.0)) if low < z < high]:
            made.station(uptime=uptime, setting=setting, frames=5, plate=pose((0, 0, z)))
            uptime += 5.0
    return made


def grey_wedge():
    """Wedge moved across at 1.728, 2.344 and 2.944 m (sec. 3.3.5)."""
    wedge = np.geomspace(0.9, 0.02, 40)
    reference = np.full(40, 0.6)
    made = Experiment(
        """
Grey wedge (Kahlmann 2007, sec. 3.3.5): a plate of 2.0 x 0.4 m with 40 fields of 5 cm from white (0.90) to black (0.02) and above
them a reference strip (0.60), moved across by a trolley in steps of 0.1 m, at 1.728, 2.344 and 2.944 m, at three settings.
Determines: amplitude_offset, noise, integration_time_offset; with fields side by side also scattering.
""",
        [
            surface(
                "wedge",
                "rectangle",
                sigma=(5e-4, 5e-4),
                size="[2.0, 0.4]",
                texture=texture((0.05, 0.1), [reference, wedge, wedge, wedge]),
            )
        ],
    )
    uptime = WARM
    for z in (1.728, 2.344, 2.944):
        for setting in SETTINGS:
            for x in np.arange(-0.95, 0.96, 0.1):
                at = pose((PIXEL[0] * z + x, PIXEL[1] * z, z))
                made.station(uptime=uptime, setting=setting, frames=5, wedge=at)
                uptime += 5.0
    return made


def rotating_plate():
    """Plate turned from -90 to 90 gon at 2.5 m (sec. 3.3.6)."""
    rows = [[0.85], [0.30], [0.85], [0.12]]
    made = Experiment(
        """
Rotating plate (Kahlmann 2007, sec. 3.3.6): a plate of 0.6 x 0.8 m, 2.5 m away, turned about the vertical by a motorised theodolite from
-90 to 90 gon every 10 gon (1 gon = 0.9 deg), at three settings. Bands of three reflectivities, since on one reflectivity the
amplitude falls with the angle and the two effects cancel to a tenth. Determines: incidence_angle; amplitude_offset.
""",
        [
            surface(
                "plate",
                "rectangle",
                sigma=(5e-4, 3e-4),
                size="[0.6, 0.8]",
                texture=texture((0.6, 0.2), np.repeat(rows, 2, axis=1)),
            )
        ],
    )
    uptime = WARM
    for setting in SETTINGS:
        for gon in range(-90, 91, 10):
            at = pose((0, 0, 2.5), about("y", gon * GON))
            made.station(uptime=uptime, setting=setting, plate=at)
            uptime += 8.0
    return made


def white_wall():
    """White wall at 1.366 and 2.463 m, 3 rounds of three settings (secs. 3.3.3, 3.3.9)."""
    made = Experiment(
        """
White wall (Kahlmann 2007, secs. 3.3.3 and 3.3.9): a wall that fills the view, perpendicular to the optical axis, at 1.366 m (fixed pattern)
and 2.463 m (precision), 60 frames at each of three settings, in three rounds.
Determines: fixed_pattern_offset, noise, emission_pattern, emitter_offset, radiometry.
""",
        [surface("wall", "plane", sigma=(0.001, 5e-4), reflectivity=WHITE)],
    )
    uptime = WARM
    for z in (1.366, 2.463):
        for _ in range(3):
            for setting in SETTINGS:
                made.station(uptime=uptime, setting=setting, frames=20, wall=pose((0, 0, z)))
                uptime += 10.0
        uptime += 300.0
    return made


def cold_start():
    """Fixed target for 40 min from power-on (secs. 3.3.7, 4.3.1)."""
    made = Experiment(
        """
Cold start (Kahlmann 2007, secs. 3.3.7 and 4.3.1): a fixed white wall at 1.166 m from power-on for 40 min. Bursts of 5 frames within
0.4 s, in which an SR-3000 drifts by 3 mm at first: every 2 s in the first minute, every 10 s up to 6 min, then every minute.
Determines: warm_up_drift; with a reference recorded also the scale of reference_path.
""",
        [surface("wall", "plane", sigma=(0.001, 5e-4), reflectivity=0.8)],
    )
    times = [*np.arange(0, 60, 2.0), *np.arange(60, 360, 10.0), *np.arange(360, 2401, 60.0)]
    for i, uptime in enumerate(times):
        placed = {"wall": pose((0, 0, 1.166))} if i == 0 else {}
        made.station(uptime=uptime, setting=100, frames=5, **placed)
    return made


# hours of the climate cell after its first steady state, degC: steps of 2 h, of which the change takes 30 min (fig. 3.37)
CLIMATE = [10, 0, -10, 0, 10, 20, 30, 40, 30, 20, 10]


def climate_at(hours):
    """Return the temperature in degC of the climate cell."""
    times, values = [0.0], [float(CLIMATE[0])]
    for i, (before, after) in enumerate(pairwise(CLIMATE), 1):
        times += [2.0 * i, 2.0 * i + 0.5]
        values += [float(before), float(after)]
    return float(np.interp(hours, times, values))


def climate_cell():
    """Two plates through -10..40 degC (sec. 3.3.7)."""
    made = Experiment(
        """
Climate cell (Kahlmann 2007, sec. 3.3.7, figs. 3.36 and 3.37): two white plates at 1.628 m and 1.996 m before black cardboard, the camera
warm, through 10, 0, -10, 0, 10, 20, 30, 40, 30, 20, 10 degC in steps of 2 h: 30 min of change, then rest, from which the lag of the body
follows. 5 frames every 5 min. Determines: ambient_temperature; the scale of reference_path where a reference is recorded.
""",
        [
            surface("lower_plate", "rectangle", sigma=(0.001, 5e-4), size="[0.6, 0.2]", reflectivity=0.8),
            surface("middle_plate", "rectangle", sigma=(0.001, 5e-4), size="[0.6, 0.25]", reflectivity=0.8),
            surface("cardboard", "plane", sigma=(0.002, 1e-3), reflectivity=BLACK),
        ],
    )
    for i, minute in enumerate(range(0, 22 * 60 + 1, 5)):
        placed = {}
        if i == 0:
            # seen by pixels 106/87 and 71/87 at 1.628 and 1.996 m along their rays
            low = (PIXEL[0], (106 - 82.3925) / 199.8875)
            z = [r / np.sqrt(1 + x**2 + y**2) for r, (x, y) in ((1.628, low), (1.996, PIXEL))]
            placed = {
                "lower_plate": pose((low[0] * z[0], low[1] * z[0], z[0])),
                "middle_plate": pose((PIXEL[0] * z[1], PIXEL[1] * z[1], z[1])),
                "cardboard": pose((0, 0, 2.3)),
            }
        made.station(
            uptime=3600.0 + 60.0 * minute, setting=100, frames=5, ambient=climate_at(minute / 60), **placed
        )
    return made


# camera stations before the circle field: distance [m], pan and tilt of the field [deg], roll [deg], offset of its centre [m]
FIELD_STATIONS = [
    (1.50, 0, 0, 0, (0.00, 0.00)), (1.50, 0, 0, 90, (0.00, 0.00)), (1.50, 0, 0, 180, (0.05, -0.04)), (1.50, 0, 0, 270, (-0.05, 0.04)),
    (1.55, 35, 0, 0, (0.00, 0.02)), (1.55, -35, 0, 90, (0.03, 0.00)), (1.50, 0, 35, 180, (0.00, -0.03)), (1.50, 0, -35, 270, (-0.02, 0.00)),
    (1.70, 30, 25, 45, (0.00, 0.00)), (1.70, -30, 25, 135, (0.04, 0.02)), (1.70, 30, -25, 225, (-0.04, 0.00)), (1.70, -30, -25, 315, (0.00, 0.03)),
    (2.20, 45, 0, 0, (-0.25, 0.12)), (2.20, -45, 0, 90, (0.22, -0.10)), (2.20, 0, 40, 180, (0.25, 0.10)), (2.20, 0, -40, 270, (-0.22, -0.12)),
]  # fmt: skip
FIELD_PITCH = 0.20
FIELD_LABEL = 2e-4  # the labels are this much thicker than nothing, m


def circle_field():
    """Twenty-five discs of 11.7 cm from 16 stations (sec. 3.2.2)."""
    made = Experiment(
        """
Circle field (Kahlmann 2007, sec. 3.2.2): 25 white labels of 11.7 cm diameter on a black plate of 1.0 x 1.0 m, every 0.20 m; disc_i_j has its
centre at x = (j - 2) 0.20, y = (i - 2) 0.20 in the frame of the plate. 16 camera stations: four rolled by 90 deg each, eight
converging by 25 to 35 deg, four farther away towards the corners of the image by up to 45 deg.
Determines: optics (camera_constant, lens_distortion), from the amplitude image.
""",
        [
            surface("field", "rectangle", sigma=(1e-4, 1e-4), size="[1.0, 1.0]", reflectivity=BLACK),
            *(
                surface(f"disc_{i}_{j}", "disc", sigma=(1e-4, 1e-4), radius=0.0585, reflectivity=WHITE)
                for i in range(5)
                for j in range(5)
            ),
        ],
    )
    for k, (z, pan, tilt, roll, offset) in enumerate(FIELD_STATIONS):
        turn = about("z", np.radians(roll))
        rotation = turn @ about("y", np.radians(pan)) @ about("x", np.radians(tilt))
        centre = turn @ np.array([*offset, z])
        poses = {"field": pose(centre, rotation)}
        for i in range(5):
            for j in range(5):
                local = np.array([(j - 2) * FIELD_PITCH, (i - 2) * FIELD_PITCH, -FIELD_LABEL])
                poses[f"disc_{i}_{j}"] = pose(centre + rotation @ local, rotation)
        made.station(uptime=WARM + 30.0 * k, setting=100, frames=20, **poses)
    return made


TARGETS = (0.85, 0.60, 0.40, 0.25, 0.12, 0.06)


def scattering():
    """Small targets before a white and a black wall, and an object moved into view (sec. 3.3.1)."""
    made = Experiment(
        """
Scattering (Kahlmann 2007, sec. 3.3.1). First, fig. 3.10: six targets of 2 x 2 cm and different reflectivity at 1.660 m, 0.1 m before a wall that
is white, then black, then white again. Second, figs. 3.13 and 3.14: an object of 0.3 x 0.8 m at 1.1 m moved through the
view before a white wall at 2.5 m, from outside it to outside it. What is not there is parked at z = -5, behind the camera.
Determines: scattering, mixed_pixels.
""",
        [
            *(
                surface(
                    f"target_{i}", "rectangle", sigma=(5e-4, 1e-3), size="[0.02, 0.02]", reflectivity=value
                )
                for i, value in enumerate(TARGETS)
            ),
            surface("object", "rectangle", sigma=(0.001, 5e-4), size="[0.3, 0.8]", reflectivity=WHITE),
            surface("white_wall", "rectangle", sigma=(0.001, 5e-4), size="[3.0, 2.4]", reflectivity=WHITE),
            surface("black_wall", "rectangle", sigma=(0.001, 5e-4), size="[3.0, 2.4]", reflectivity=BLACK),
        ],
    )
    away = pose(AWAY)
    uptime = WARM
    targets = {
        f"target_{i}": pose((0.12 * (i % 3 - 1) + PIXEL[0] * 1.66, 0.12 * (i // 3 - 0.5) - 0.03, 1.66))
        for i in range(len(TARGETS))
    }
    for white in (True, False, True):
        wall, other = ("white_wall", "black_wall") if white else ("black_wall", "white_wall")
        for _ in range(3):
            made.station(
                uptime=uptime,
                setting=100,
                frames=20,
                **targets,
                object=away,
                **{wall: pose((0, 0, 1.76)), other: away},
            )
            uptime += 5.0
        uptime += 60.0
    for i, x in enumerate(np.arange(-0.75, 0.76, 0.05)):
        placed = {"object": pose((x, 0.0, 1.1))}
        if i == 0:
            placed |= dict.fromkeys(targets, away) | {"white_wall": pose((0, 0, 2.5)), "black_wall": away}
        made.station(uptime=uptime, setting=100, **placed)
        uptime += 5.0
    return made


def integration_times():
    """Grey fields at three distances, the settings back and forth (sec. 3.3.2)."""
    made = Experiment(
        """
Integration times (Kahlmann 2007, sec. 3.3.2): a board of 1.0 x 0.8 m with grey fields at 1.3, 2.2 and 3.6 m; at each the settings 16, 60, 100, 100,
60, 16, so that a slow drift cancels, and many amplitudes at each setting, so that an offset of the setting is distinguished from that
of the amplitude. Determines: integration_time_offset, amplitude_offset, noise.
""",
        [
            surface(
                "board",
                "rectangle",
                sigma=(5e-4, 5e-4),
                size="[1.0, 0.8]",
                texture=texture((0.1, 0.1), GREYS),
            )
        ],
    )
    uptime = WARM
    for z in (1.3, 2.2, 3.6):
        for setting in (*SETTINGS, *SETTINGS[::-1]):
            made.station(uptime=uptime, setting=setting, frames=20, board=pose((0, 0, z)))
            uptime += 5.0
        uptime += 30.0
    return made


def two_cameras():
    """Grey fields that a second camera lights as well (eq. 2.11)."""
    fields = np.resize(np.array(GREYS), (10, 12))
    made = Experiment(
        f"""
Two cameras (Kahlmann 2007, eq. 2.11): a wall of grey fields at 2.5 m that fills the view, at three settings in three rounds. Record it twice: with the
second camera off (simulate with the camera `sr3000`) and on (`{SECOND_CAMERA}`). The noise that the second one adds is common
to all pixels of a frame and is larger where the amplitude is small. Determines: interference.
""",
        [
            surface(
                "wall",
                "rectangle",
                sigma=(0.001, 5e-4),
                size="[2.4, 2.0]",
                texture=texture((0.2, 0.2), fields),
            )
        ],
    )
    for i in range(9):
        made.station(uptime=WARM + 10.0 * i, setting=SETTINGS[i % 3], frames=20, wall=pose((0, 0, 2.5)))
    return made


def board_by_hand():
    """Forty poses of a board with grey fields, 0.5 to 6 m, held by hand."""
    made = Experiment(
        """
Board by hand: a board of 1.0 x 0.8 m with grey fields, held at 40 poses 0.5 to 6 m away all over the view and tilted by up to 55 deg, each at
the settings at which white neither saturates nor is dim. The shortest plan: in about ten minutes distances, amplitudes,
angles, settings and pixels vary independently, if less finely than in the experiments of their own. The poses come from a marker on the
board or a tracker, less exact than a track line. Determines, together: cyclic_error, amplitude_offset, incidence_angle,
integration_time_offset, distance_scale, optics, scattering.
""",
        [
            surface(
                "board",
                "rectangle",
                sigma=(0.002, 0.002),
                size="[1.0, 0.8]",
                texture=texture((0.1, 0.1), GREYS),
            )
        ],
    )
    rng = np.random.default_rng(2007)
    uptime = WARM
    for z in rng.permutation(np.geomspace(0.5, 6.0, 40)):
        steepest = min(np.radians(55), np.arcsin(min(1.0, (z - 0.3) / 0.65)))
        tilt, direction, roll = rng.uniform(0, steepest), rng.uniform(0, 2 * np.pi), rng.normal(0, 0.2)
        rotation = about("z", direction) @ about("y", tilt) @ about("z", roll - direction)
        # the whole board in view from 2 m on, nearer its centre near the axis
        free = np.clip(np.array([0.44, 0.36]) * z - np.array([0.5, 0.4]), 0.03, None)
        x, y = rng.uniform(-1, 1, 2) * free
        for setting in SETTINGS:
            if 300 < 500 * setting * WHITE / z**2 < 38000:
                at = pose((round(x, 4), round(y, 4), round(z, 4)), rotation)
                made.station(uptime=uptime, setting=setting, frames=5, board=at)
                uptime += 2.0
        uptime += 6.0
    return made


EXPERIMENTS = {
    f"{make.__name__}_experiment": make
    for make in (
        track_line, grey_wedge, rotating_plate, white_wall, cold_start, climate_cell, circle_field, scattering,
        integration_times, two_cameras, board_by_hand,
    )
}  # fmt: skip
