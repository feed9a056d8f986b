"""Quality of service: sensor data by default, reliable by a parameter; warnings state the remedy."""

from __future__ import annotations

from typing import Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

SENSOR_DATA = "sensor_data"
RELIABLE = "reliable"
CHOICES = (SENSOR_DATA, RELIABLE)

#: Messages kept for a slow peer: few where late ones are useless (sensor data), many where none may be lost.
_DEPTH = {SENSOR_DATA: 5, RELIABLE: 50}


def profile(name: str, *, depth: int | None = None) -> QoSProfile:
    """Return the profile ``sensor_data`` (best effort) or ``reliable``, both volatile.

    ``depth``: messages that may wait; None: the default of the profile.
    """
    reliability = ReliabilityPolicy.RELIABLE if name == RELIABLE else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(
        depth=depth or _DEPTH[name], reliability=reliability, durability=DurabilityPolicy.VOLATILE
    )


def latched() -> QoSProfile:
    """Return the profile of poses: reliable, and the last one is kept for late subscribers."""
    return QoSProfile(
        depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
    )


def publisher(
    node: Node,
    kind: Any,
    topic: str,
    qos: QoSProfile,
    *,
    parameter: str | None = None,
    overridable: bool = True,
) -> Publisher:
    """Return a publisher that warns of incompatible subscribers; ``parameter``: that which sets ``qos``.

    ``overridable``: the parameters ``qos_overrides.<topic>.publisher.{reliability, history, depth}`` override
    it at the start.
    """

    def incompatible(event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        remedy = "choose Best Effort there (RViz: Topic, Reliability Policy)"
        if parameter is not None:
            remedy += f", or start this node with {parameter}:={RELIABLE}"
        if policy != "RELIABILITY":
            remedy = f"choose a compatible {policy.lower()} there"
        node.get_logger().warning(
            f"a subscriber of {made.topic_name} requests another {policy} than is offered and receives "
            f"nothing: {remedy}"
        )

    made = node.create_publisher(
        kind,
        topic,
        qos,
        event_callbacks=PublisherEventCallbacks(incompatible_qos=incompatible, use_default_callbacks=False),
        qos_overriding_options=QoSOverridingOptions.with_default_policies() if overridable else None,
    )
    return made


def subscription(
    node: Node, kind: Any, topic: str, callback: Any, qos: QoSProfile, *, parameter: str
) -> Subscription:
    """Return a subscription that warns of incompatible publishers; ``parameter``: that which sets ``qos``."""

    def incompatible(event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        node.get_logger().warning(
            f"a publisher of {made.topic_name} offers another {policy} than is requested, nothing comes from "
            f"it: start this node with {parameter}:={SENSOR_DATA}, or that publisher with reliable delivery"
        )

    made = node.create_subscription(
        kind,
        topic,
        callback,
        qos,
        event_callbacks=SubscriptionEventCallbacks(
            incompatible_qos=incompatible, use_default_callbacks=False
        ),
    )
    return made
