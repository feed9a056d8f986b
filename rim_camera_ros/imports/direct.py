"""Topics of a driver that need no import: radial distances, raw images, both images with the same stamp."""

from __future__ import annotations

from pathlib import Path

from rim_camera_ros.bags.storage import open_storage
from rim_camera_ros.bags.topics import DEFAULT_NAMESPACE, Topics
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.imports.profile import load_profile
from rim_camera_ros.imports.sources import find_sources


def direct_topics(name: str, path: Path, topics: Topics) -> Topics:
    """Return the topics of a profile in a recording, for reading without an import.

    ``topics``: those of the options, which have precedence. Raises `InputError` where the images must be
    converted first, with the command for it.
    """
    profile = load_profile(name)
    remedy = f"convert it first: rim import {path} --profile {name} --out BAG"
    if profile.distance.kind != "radial" or profile.distance.offset:
        meaning = "depth along z" if profile.distance.kind == "z" else "not plain radial counts"
        raise InputError(f"the distance of {profile.driver} is {meaning}", place="--profile", remedy=remedy)
    storage = open_storage(path)
    try:
        types = {topic: info.msgtype for topic, info in storage.topics.items()}
        named = {
            role: topics[role]
            for role in ("distance", "amplitude", "camera_info")
            if role in topics.overrides
        }
        namespace = None if topics.namespace == DEFAULT_NAMESPACE else topics.namespace
        sources = find_sources(profile, types, namespace=namespace, named=named)
    except RimError as error:
        raise error.located(path) from None
    finally:
        storage.close()
    for source in (sources.distance, sources.amplitude):
        if source.transport != "raw":
            raise InputError(f"{source.topic} is compressed", file=path, place="--profile", remedy=remedy)
    found = {"distance": sources.distance.topic, "amplitude": sources.amplitude.topic}
    if sources.camera_info is not None:
        found["camera_info"] = sources.camera_info
    return Topics(topics.namespace, {**found, **topics.overrides})
