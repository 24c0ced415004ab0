# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Node of ``starcal request``: calls one service of a running calibrator and prints the answer.

Exit status 0: done; 3: the calibrator declined; 2: no calibrator, no answer, or no file.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import sys
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_srvs.srv import Trigger

from starcal.srv import Calibrate, LineOfSightTable
from starcal_ros.assessment import lookup
from starcal_ros.errors import ProductError
from starcal_ros.formats.products.lookup_table import write_lookup_table
from starcal_ros.ros.lifecycle_node.node_process import shut_down
from starcal_ros.text import printable

_TYPES = {'solve': Calibrate, 'lookup': LineOfSightTable}  # the others are Trigger
_DISCOVERY_S = 10.0


def ask(node: Node, args: argparse.Namespace) -> int:
    """Call the service; return the exit status."""
    kind = _TYPES.get(args.service, Trigger)
    # Relative, so that a namespace or a remap of the service leads to another calibrator.
    name = node.resolve_service_name(f'calibrator/{args.service}')
    client = node.create_client(kind, name)
    if not client.wait_for_service(timeout_sec=min(_DISCOVERY_S, args.timeout)):
        return _failed(
            f'no service {name}: is the calibrator running, and in this namespace and '
            'ROS_DOMAIN_ID? Try --remap __ns:=/NAME'
        )
    fields: dict[str, Any] = {}
    if args.service == 'solve':
        fields = {'dry_run': args.dry_run, 'force': args.force}
    future = client.call_async(kind.Request(**fields))
    rclpy.spin_until_future_complete(node, future, timeout_sec=args.timeout)
    if not future.done():
        return _failed(
            f'no answer of {name} within {args.timeout:g} s; the request may still be '
            'carried out: look with starcal monitor'
        )
    answer = future.result()
    print(printable(answer.message))
    if answer.success and args.service == 'lookup':
        write_lookup_table(_table(answer), args.output)
        print(f'written: {args.output}')
    return 0 if answer.success else 3


def _failed(why: str) -> int:
    print(f'starcal request: {why}', file=sys.stderr)
    return 2


def _table(answer: Any) -> lookup.LineOfSightTable:
    column = {name: np.array(getattr(answer, name)) for name in lookup.COLUMNS}
    return lookup.LineOfSightTable(
        np.stack([column['u_px'], column['v_px']], axis=-1),
        np.stack([column[axis] for axis in 'xyz'], axis=-1),
        column['shape_sigma_arcsec'],
        column['sigma_arcsec'],
    )


def main() -> int:
    """Run the request; `starcal request` has checked its arguments."""
    parser = argparse.ArgumentParser()
    parser.add_argument('service')
    parser.add_argument('--dry-run', action='store_true')
    parser.add_argument('--force', action='store_true')
    parser.add_argument('--timeout', type=float, required=True)
    parser.add_argument('--output', type=Path)
    args = parser.parse_args(rclpy.utilities.remove_ros_args(sys.argv)[1:])
    rclpy.init()
    node = rclpy.create_node('starcal_request')
    try:
        return ask(node, args)
    except ProductError as error:
        return _failed(str(error))
    except (KeyboardInterrupt, ExternalShutdownException):
        return 130
    finally:
        node.destroy_node()
        shut_down()


if __name__ == '__main__':
    sys.exit(main())
