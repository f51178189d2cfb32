"""How the daemon joins the network, from the configuration's section `[zenoh]`."""

from __future__ import annotations

from pathlib import Path

from robominer_slam.configuration.zenoh_section import ZenohSection
from robominer_slam.publishing.ros_bridge import RosSettings, ros_keys, ros_layout, ros_readable
from robominer_slam.publishing.tls_settings import remote_rates, tls
from robominer_slam.publishing.zenoh_settings import ZenohSettings
from robominer_slam.security.access_list import COMMANDING
from robominer_slam.security.access_rules import access_control
from robominer_slam.security.credentials import load_credentials
from robominer_slam.security.endpoints import is_tls


def robot_settings(section: ZenohSection, folder: Path, prefix: str) -> ZenohSettings:
    """Settings of the daemon; endpoints that leave the machine unprotected were refused with the file.

    Args:
        section: `[zenoh]`.
        folder: where its relative paths start.
        prefix: `robominer/<robot id>`.

    Raises:
        KeysError: credentials that cannot be used.
    """
    ros = None if section.ros == "none" else RosSettings(section.ros, section.ros_domain)
    if section.credentials is None:
        return ZenohSettings(listen=section.listen, connect=section.connect, ros=ros)
    layout = None if ros is None else ros_layout(ros, prefix)
    credentials = load_credentials(folder / section.credentials)
    access = credentials.access_list()
    return ZenohSettings(
        listen=section.listen,
        connect=section.connect,
        remote=any(is_tls(endpoint) for endpoint in (*section.listen, *section.connect)),
        commanders=access.names(COMMANDING),
        ros=ros,
        further={
            **tls(credentials, serves=True),
            "access_control": access_control(access, prefix, () if layout is None else ros_readable(layout)),
            **remote_rates(prefix, {} if layout is None else ros_keys(layout), remote_ros=section.remote_ros),
        },
    )
