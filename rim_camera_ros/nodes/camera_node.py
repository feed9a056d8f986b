"""A camera in one process: driver, correction and, with the parameter ``people``, the node for people.

The nodes have the same names, topics, services and parameters as in separate processes. Frames go from one to
the next in memory, and the raw topics are published only while somebody listens.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

from rim_camera_ros.effects import registry
from rim_camera_ros.nodes.common.handover import CorrectedCloud, Exposure, Handover
from rim_camera_ros.nodes.common.run import Service, run
from rim_camera_ros.nodes.correction import parameters as correction_parameters
from rim_camera_ros.nodes.correction.node import CorrectionNode
from rim_camera_ros.nodes.driver import parameters as driver_parameters
from rim_camera_ros.nodes.driver.node import DriverNode
from rim_camera_ros.nodes.people import parameters as people_parameters


def nodes() -> Iterator[Service]:
    """Make the nodes one after the other, receivers of frames before their sources."""
    frames, clouds = Handover[Exposure](), Handover[CorrectedCloud]()
    known = {
        spec.name
        for parameter in (driver_parameters, correction_parameters, people_parameters)
        for spec in parameter.SPECS
    }
    known |= {
        correction_parameters.PEOPLE.name,
        *(correction_parameters.EFFECT + name for name in registry()),
    }
    correction = CorrectionNode(frames=frames, clouds=clouds, elsewhere=known)
    yield correction
    if correction.follows_people:
        from rim_camera_ros.nodes.people.node import PeopleNode

        yield PeopleNode(clouds=clouds, elsewhere=known)
    yield DriverNode(frames=frames, elsewhere=known)


def main() -> int:
    """Run the nodes."""
    return run("camera_node", nodes)


if __name__ == "__main__":
    sys.exit(main())
