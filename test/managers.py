# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Client of the lifecycle services of a node."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState

if TYPE_CHECKING:
    from conftest import Client

NO_TRANSITION = 200
CONFIGURE, CLEANUP = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP
ACTIVATE, DEACTIVATE = Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE


class Manager:
    def __init__(self, client: Client, name: str) -> None:
        self._client = client
        self._change = client.node.create_client(ChangeState, f'/{name}/change_state')
        self._get = client.node.create_client(GetState, f'/{name}/get_state')
        client.until(lambda: self._change.service_is_ready() and self._get.service_is_ready())
        # The first answer may be lost, before the node has found its reader: what changes nothing.
        client.ask(self._change, _to(NO_TRANSITION), again_s=5.0)
        client.ask(self._get, GetState.Request(), again_s=5.0)

    def _call(self, service: Any, request: Any) -> Any:
        future = service.call_async(request)
        self._client.until(future.done)
        return future.result()

    def change(self, number: int) -> bool:
        """Request a transition; return True if the node made it."""
        return bool(self._call(self._change, _to(number)).success)

    def state(self) -> str:
        return str(self._call(self._get, GetState.Request()).current_state.label)


def _to(number: int) -> Any:
    return ChangeState.Request(transition=Transition(id=number))
