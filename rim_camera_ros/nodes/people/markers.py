"""People as markers: a cylinder, a number, and a line for the path so far."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable, Sequence

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from rim_camera_ros.tracking.ground import Ground
from rim_camera_ros.tracking.tracks import Track

#: Namespaces of the three markers of a person; the id is the person's identity.
BODY, NUMBER, TRAIL = "people", "numbers", "trails"
#: Seconds after which markers disappear if the node ends.
_LIFETIME = Duration(sec=2)
_DIAMETER, _LINE, _LETTERS = 0.4, 0.03, 0.25
#: Turns of the colour circle from one identity to the next: neighbours differ the most.
_GOLDEN = 0.61803398875


def markers(
    people: Sequence[Track], gone: Iterable[int], ground: Ground, head: Header, *, trail: float
) -> MarkerArray:
    """Return the markers of people, in the optical frame of ``head``, and deletions of identities ``gone``.

    Hidden people are pale. ``trail`` [s]: length of the line.
    """
    result = MarkerArray()
    for person in people:
        result.markers += [_body(person, ground, head), _number(person, ground, head)]
        result.markers.append(_trail(person, ground, head, trail))
    for identity in gone:
        for space in (BODY, NUMBER, TRAIL):
            result.markers.append(Marker(header=head, ns=space, id=identity, action=Marker.DELETE))
    return result


def cleared() -> MarkerArray:
    """Return the message that deletes all markers."""
    return MarkerArray(markers=[Marker(action=Marker.DELETEALL)])


def _marker(person: Track, space: str, kind: int, head: Header) -> Marker:
    red, green, blue = colorsys.hsv_to_rgb(person.identity * _GOLDEN % 1.0, 0.8, 1.0)
    result = Marker(
        header=head, ns=space, id=person.identity, type=kind, action=Marker.ADD, lifetime=_LIFETIME
    )
    result.color = ColorRGBA(r=red, g=green, b=blue, a=0.3 if person.hidden else 0.8)
    result.pose.orientation.w = 1.0
    return result


def _point(ground: Ground, x: float, y: float, z: float) -> Point:
    x, y, z = ground.to_optical(np.array([[x, y, z]]))[0]
    return Point(x=float(x), y=float(y), z=float(z))


def _body(person: Track, ground: Ground, head: Header) -> Marker:
    result = _marker(person, BODY, Marker.CYLINDER, head)
    x, y = (float(value) for value in person.position)
    result.pose.position = _point(ground, x, y, person.top / 2)
    turn = result.pose.orientation
    turn.x, turn.y, turn.z, turn.w = (float(q) for q in ground.rotation.inv().as_quat())
    result.scale.x = result.scale.y = _DIAMETER
    result.scale.z = person.top
    return result


def _number(person: Track, ground: Ground, head: Header) -> Marker:
    result = _marker(person, NUMBER, Marker.TEXT_VIEW_FACING, head)
    x, y = (float(value) for value in person.position)
    result.pose.position = _point(ground, x, y, person.top + _LETTERS)
    result.scale.z = _LETTERS
    result.text = str(person.identity)
    return result


def _trail(person: Track, ground: Ground, head: Header, seconds: float) -> Marker:
    result = _marker(person, TRAIL, Marker.LINE_STRIP, head)
    result.scale.x = _LINE
    result.points = [
        _point(ground, x, y, 0.0) for time, x, y in person.trail if time >= person.time - seconds
    ]
    return result
