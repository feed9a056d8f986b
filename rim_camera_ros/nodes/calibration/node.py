"""The calibration node: makes a camera file from recordings of known scenes while the robot goes on.

The work is done in a separate process (`process`, `recording`), which may crash, be killed or be cancelled
without effect on the node. The camera file that it starts from is never changed. Topics and services are
below the node's name, ``/camera/calibration`` unless another namespace is given.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Set
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from std_srvs.srv import SetBool, Trigger

from rim_camera_ros.errors import RimError
from rim_camera_ros.nodes.calibration import parameters
from rim_camera_ros.nodes.calibration.status import CalibrationStatus
from rim_camera_ros.nodes.calibration.supervision import WorkProcess
from rim_camera_ros.nodes.common import qos
from rim_camera_ros.nodes.common.diagnostics import Diagnostics
from rim_camera_ros.nodes.common.findings import Finding
from rim_camera_ros.nodes.common.folders import Folders
from rim_camera_ros.nodes.common.lifecycle import ACTIVE, ManagedNode
from rim_camera_ros.nodes.common.parameters import Apply, Parameters, Values
from rim_camera_ros.nodes.common.run import run

#: Seconds between two checks of the work.
_TICK = 0.1
#: Seconds that the node waits at its end until its last result was received.
_LAST_WORDS = 1.0
_CALIBRATION, _RECORDING = "calibration", "recording"


class CalibrationNode:
    """Calibrates and records on request, one job at a time; it never ends by itself."""

    status: int | None = None

    def __init__(self) -> None:
        self.node = ManagedNode("calibration")
        self._log = self.node.log
        self._parameters = Parameters(self.node, parameters.SPECS)
        values = self._parameters.values
        self._folders = Folders(values["folders"], given=parameters.given_files(values))
        parameters.check(values, parameters.NEW, self._folders)  # files are looked for once they are used
        self._status = CalibrationStatus()
        self._work: WorkProcess | None = None
        self._progress: Publisher | None = None
        self._result: Publisher | None = None
        self._parameters.watch(self._prepare)
        self._parameters.warn_unknown()
        self.node.start(self, autostart=values["autostart"])
        self._timer = self.node.steady_timer(_TICK, self._look_at_work)
        self._services = [
            self.node.create_service(kind, f"~/{name}", _answering(serve))
            for name, kind, serve in (
                ("start", Trigger, self._start),
                ("cancel", Trigger, self._cancel),
                ("record", SetBool, self._record),
            )
        ]
        self._diagnostics = Diagnostics(self.node, {"work": self._look}, hardware=lambda: "")

    def close(self) -> None:
        """End the work: a calibration is cancelled, a recording keeps what has come."""
        self.node.end()

    # --- lifecycle ------------------------------------------------------------------------------

    def configure(self) -> None:
        """Offer the topics."""
        self._progress = qos.publisher(self.node, DiagnosticArray, "~/progress", qos.profile(qos.RELIABLE))
        self._result = qos.publisher(self.node, DiagnosticArray, "~/result", qos.latched())

    def activate(self) -> None:
        """Take requests from now on."""

    def deactivate(self) -> None:
        """End the work: a calibration is cancelled, a recording keeps what has come."""
        work = self._work
        if work is None:
            return
        if work.work == _RECORDING:
            work.finish()
        else:
            work.cancel()
        self._ended(work, work.stop() or {"failed": f"process {work.pid} cannot be ended"})

    def cleanup(self) -> None:
        """Remove the topics, once the result of work that was just ended has been received."""
        if self._result is not None:
            self._result.wait_for_all_acked(Duration(seconds=_LAST_WORDS))
        for publisher in (self._progress, self._result):
            if publisher is not None:
                self.node.destroy_publisher(publisher)
        self._progress = self._result = None

    # --- the work -------------------------------------------------------------------------------

    def _look_at_work(self) -> None:
        """Publish what the process has reported since the last call."""
        work = self._work
        if work is None:
            return
        progress, end = work.poll()
        for one in progress:
            self._status.advance(one)
            self._publish(self._progress, "progress", self._status.progress(work.seconds))
        if end is not None:
            self._ended(work, end)

    def _ended(self, work: WorkProcess, end: dict[str, Any]) -> None:
        self._work = None
        finding = self._status.end(end, seconds=work.seconds)
        self._publish(self._result, "result", finding)
        if "failed" not in end:  # the diagnostics log errors
            self._log.info(finding.message)
        for note in end.get("result", {}).get("notes", ()):
            self._log.info(f"note: {note}")
        if work.work == _RECORDING and "result" in end:
            recordings = parameters.with_recording(self._parameters.values, end["result"]["file"])
            (taken,) = self.node.set_parameters([Parameter("recordings", value=recordings)])
            if not taken.successful:
                self._log.error(f"the recording is not added to recordings: {taken.reason}")

    def _publish(self, publisher: Publisher | None, what: str, finding: Finding) -> None:
        if publisher is None:
            return
        message = DiagnosticArray()
        message.header.stamp = self.node.get_clock().now().to_msg()
        status = DiagnosticStatus(
            level=bytes([finding.level]),
            name=f"{self.node.get_fully_qualified_name()}: {what}",
            message=finding.message,
            values=[KeyValue(key=key, value=value) for key, value in finding.values.items()],
        )
        message.status.append(status)
        publisher.publish(message)

    def _look(self) -> Finding:
        self._status.phase = self.node.phase
        return self._status.look(None if self._work is None else self._work.seconds)

    # --- parameters and services ----------------------------------------------------------------

    def _prepare(self, values: Values, changed: Set[str]) -> Apply:
        """Check new values; they take effect with the next work."""
        parameters.check(values, changed, self._folders)
        return _nothing

    def _start(self, request: Any) -> str:
        self._require_free()
        given = parameters.calibration_of(self._parameters.values, self._folders)
        self._begin(_CALIBRATION, given)
        return f"calibrating; the camera file will be {given['output']}"

    def _record(self, request: Any) -> str:
        work = self._work
        if not request.data:
            if work is None or work.work != _RECORDING:
                raise RimError("nothing is being recorded")
            work.finish()
            self._status.asked("finishing")
            return "the recording is being finished"
        self._require_free()
        given = parameters.recording_of(
            self._parameters.values, self._folders, namespace=self.node.get_namespace()
        )
        self._begin(_RECORDING, given)
        return f"recording to {given['output']}"

    def _cancel(self, request: Any) -> str:
        work = self._work
        if work is None:
            raise RimError("nothing is being done")
        work.cancel()
        self._status.asked("cancelling")
        return f"the {work.work} is being cancelled"

    def _require_free(self) -> None:
        if self.node.phase != ACTIVE:
            raise RimError(
                f"the node is {self.node.phase}", remedy=f"activate {self.node.get_fully_qualified_name()}"
            )
        if self._work is not None:
            raise RimError(f"a {self._work.work} runs already", remedy="wait for its end, or call cancel")

    def _begin(self, what: str, given: dict[str, Any]) -> None:
        self._work = WorkProcess(what, given)
        self._status.begin(what, pid=self._work.pid)
        self._log.info(f"{what}: process {self._work.pid} writes {given['output']}")


def _answering(serve: Callable[[Any], str]) -> Callable[[Any, Any], Any]:
    """Return the callback of a service whose message is what ``serve`` returns, or the error it raises."""

    def answer(request: Any, response: Any) -> Any:
        try:
            response.message = serve(request)
            response.success = True
        except Exception as error:
            known = isinstance(error, RimError)
            response.message = str(error) if known else f"unexpected {type(error).__name__}: {error}"
            response.success = False
        return response

    return answer


def _nothing() -> None:
    """A change of parameters takes effect with the next work."""


def main() -> int:
    """Run the calibration."""
    return run("calibration_node", lambda: [CalibrationNode()])


if __name__ == "__main__":
    sys.exit(main())
