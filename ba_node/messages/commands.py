# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Name the types of the services and actions that stand below the node's own name."""

SERVICE_TYPES = {
    "reset": "std_srvs/srv/Trigger",
    "pause": "std_srvs/srv/SetBool",
    "save_map": "ba_msgs/srv/SaveMap",
    "load_map": "ba_msgs/srv/LoadMap",
}
ACTION_TYPES = {"optimize": "ba_msgs/action/Optimize"}
