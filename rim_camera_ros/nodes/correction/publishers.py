"""Who publishes the topics that a node takes: with several publishers of a topic two cameras are mixed."""

from __future__ import annotations

from collections.abc import Iterable

from rclpy.node import Node

from rim_camera_ros.nodes.common.findings import Finding, Level

#: Publishers of a topic: their names by their identifiers.
_Publishers = dict[bytes, str]


class PublisherWatch:
    """Counts the publishers of topics, and warns once of each change where one has several.

    Neither names nor messages distinguish two nodes of the same name: publishers are counted by
    the identifiers (gid) that the middleware gives them. ``topics`` are relative to the node's namespace. A
    change counts when two consecutive calls find the same: publishers are discovered one by one.
    """

    def __init__(self, node: Node, topics: Iterable[str]) -> None:
        self._node = node
        self._topics = [node.resolve_topic_name(topic) for topic in topics]
        self._last: dict[str, _Publishers] = {}
        self._settled: dict[str, _Publishers] = {}

    def look(self) -> Finding:
        """Return who publishes; with more than one publisher as a warning, which is logged if it is new."""
        found = {topic: self._publishers(topic) for topic in self._topics}
        news = found == self._last != self._settled
        self._last = found
        if news:
            self._settled = found
        finding = Finding(values={topic: _listed(settled) for topic, settled in self._settled.items()})
        several = {topic: _listed(settled) for topic, settled in self._settled.items() if len(settled) > 1}
        if not several:
            finding.note("one camera at most")
            return finding
        groups = [
            f"{names} publish {', '.join(topic for topic in several if several[topic] == names)}"
            for names in sorted(set(several.values()))
        ]
        sentence = (
            f"frames of several publishers mix: {'; '.join(groups)}; end all but one, or give each camera a "
            "namespace of its own (a process that was killed counts for 20 s more)"
        )
        finding.worse(Level.WARN, sentence)
        if news:
            self._node.get_logger().warning(sentence)
        return finding

    def _publishers(self, topic: str) -> _Publishers:
        return {
            bytes(
                topic_endpoint_info.endpoint_gid
            ): f"{topic_endpoint_info.node_namespace.rstrip('/')}/{topic_endpoint_info.node_name}"
            for topic_endpoint_info in self._node.get_publishers_info_by_topic(topic)
        }


def _listed(publishers: _Publishers) -> str:
    return ", ".join(sorted(publishers.values()))
