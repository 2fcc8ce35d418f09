# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Have rclpy's own services answer also when their callback raises: parameters, states, type descriptions."""

from __future__ import annotations

import traceback
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import SetParametersResult

from ba_node.ros.log import Severity, fault, log, printable

if TYPE_CHECKING:
    from collections.abc import Callable


_SET = "rcl_interfaces/SetParametersResult"


def answering(node: Any, name: str, kind: Any, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Return a callback that answers with a refusal, as far as the type of the response can say one, when it raises.

    Args:
        node: whose log hears of it.
        name: of the service.
        kind: class of its responses.
        callback: takes request and response, returns the response.
    """

    def answer(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except Exception as error:
            log(node, Severity.ERROR, f"{name} was answered with a refusal: {traceback.format_exc()}")
            return _refusal(kind, request, printable(fault(error)))

    return answer


def _refusal(kind: Any, request: Any, reason: str) -> Any:
    """Return a response without success: rclpy's types have it in different places."""
    response = kind()
    types = response.get_fields_and_field_types()
    if "failure_reason" in types:
        response.failure_reason = reason
    if types.get("result") == _SET:
        response.result.reason = reason
    if types.get("results") == f"sequence<{_SET}>":
        reason += "; those of the request before the one at fault are set"
        response.results = [SetParametersResult(successful=False, reason=reason) for _ in request.parameters]
    return response
