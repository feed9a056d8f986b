"""SROS 2: a node in an enclave starts, and without its keys it does not; needs a middleware built with it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from test.ros.harness import World

_SCHEMA = 'xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:noNamespaceSchemaLocation="http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_{}.xsd"'
_DOMAINS = "<domains><id_range><min>0</min><max>230</max></id_range></domains>"
_GOVERNANCE = f"""<?xml version="1.0" encoding="UTF-8"?>
<dds {_SCHEMA.format("governance")}><domain_access_rules><domain_rule>{_DOMAINS}
<allow_unauthenticated_participants>false</allow_unauthenticated_participants>
<enable_join_access_control>true</enable_join_access_control>
<discovery_protection_kind>ENCRYPT</discovery_protection_kind>
<liveliness_protection_kind>ENCRYPT</liveliness_protection_kind>
<rtps_protection_kind>SIGN</rtps_protection_kind>
<topic_access_rules><topic_rule><topic_expression>*</topic_expression>
<enable_discovery_protection>true</enable_discovery_protection>
<enable_liveliness_protection>true</enable_liveliness_protection>
<enable_read_access_control>true</enable_read_access_control>
<enable_write_access_control>true</enable_write_access_control>
<metadata_protection_kind>ENCRYPT</metadata_protection_kind>
<data_protection_kind>ENCRYPT</data_protection_kind>
</topic_rule></topic_access_rules></domain_rule></domain_access_rules></dds>"""
_PERMISSIONS = f"""<?xml version="1.0" encoding="UTF-8"?>
<dds {_SCHEMA.format("permissions")}><permissions>
<grant name="/camera"><subject_name>CN=/camera</subject_name>
<validity><not_before>2020-01-01T00:00:00</not_before><not_after>2040-01-01T00:00:00</not_after></validity>
<allow_rule>{_DOMAINS}<publish><topics><topic>*</topic></topics></publish>
<subscribe><topics><topic>*</topic></topics></subscribe></allow_rule><default>DENY</default>
</grant></permissions></dds>"""


def keystore(folder: Path) -> None:
    """Write what `ros2 security create_keystore` and `create_enclave` write for the enclave /camera."""
    enclave = folder / "enclaves" / "camera"
    enclave.mkdir(parents=True)

    def openssl(*arguments: object) -> None:
        subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)

    ca, ca_key = enclave / "identity_ca.cert.pem", folder / "ca.key.pem"
    curve = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    openssl("req", "-x509", *curve, "-keyout", ca_key, "-out", ca, "-days", "2", "-subj", "/CN=test CA")
    shutil.copy(ca, enclave / "permissions_ca.cert.pem")
    request, key, cert = folder / "request.pem", enclave / "key.pem", enclave / "cert.pem"
    openssl("req", *curve, "-keyout", key, "-out", request, "-subj", "/CN=\\/camera")
    openssl("x509", "-req", "-in", request, "-CA", ca, "-CAkey", ca_key, "-CAcreateserial", "-out", cert)
    for name, text in (("governance", _GOVERNANCE), ("permissions", _PERMISSIONS)):
        (enclave / f"{name}.xml").write_text(text)
        signed = enclave / f"{name}.p7s"
        signer = ("-signer", ca, "-inkey", ca_key, "-outform", "SMIME")
        openssl("smime", "-sign", "-text", "-in", enclave / f"{name}.xml", "-out", signed, *signer)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl")
def test_a_node_in_an_enclave(world: World, tmp_path: Path) -> None:
    keystore(tmp_path / "keys")
    world.environment |= {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": str(tmp_path / "keys"),
    }
    # another enclave has no keys: the node must not start without protection
    stranger = world.start("driver_node", "--enclave", "/stranger", frames=3, exit_at_end=True)
    assert stranger.wait() != 0
    assert "SECURITY ERROR: directory" in stranger.text
    assert "Traceback" not in stranger.text
    driver = world.start("driver_node", "--enclave", "/camera", frames=3, exit_at_end=True)
    status = driver.wait()
    assert "Traceback" not in driver.text
    if "doesn't have the security libraries" in driver.text:
        # the wheels' Fast DDS: refused in a line, and not started without protection
        assert status == 1
        assert "driver_node: error creating node: This Fast DDS version" in driver.text
        pytest.skip("this Fast DDS is built without security; refused as it should be")
    assert status == 0, driver.text
    assert "Found security directory" in driver.text
    assert "3 frames published" in driver.text
