"""One ROS 2 domain as rclpy sees it: a context and a node of our own, whose callbacks run on one thread.

rclpy comes with every installation of ROS 2 and speaks whatever middleware RMW_IMPLEMENTATION names. It is imported only
where a route asks for it.
"""

from __future__ import annotations

import importlib
import logging
import threading
import uuid
from typing import Any

from tutelage.errors import ConfigError

log = logging.getLogger(__name__)
NODE_PREFIX = "_tutelage_"
"""How the names of proxies' nodes begin; with the underscore, `ros2 node list` shows them with --all only."""
_PARTS = {"SendGoal": "SendGoalService", "GetResult": "GetResultService"}
_PAUSE = 0.1  # seconds after an error
_NO_LOG_FILES = ["--ros-args", "--disable-external-lib-logs"]


class RclpyDomain:
    """A node on one domain, with a thread.

    Args:
        number: of the domain, ROS_DOMAIN_ID.

    Attributes:
        node: `rclpy.node.Node`.

    Raises:
        ConfigError: rclpy is not installed, or cannot join.
    """

    def __init__(self, number: int) -> None:
        try:
            import rclpy
            from rclpy.context import Context
            from rclpy.executors import SingleThreadedExecutor
            from rclpy.parameter import Parameter
            from rclpy.signals import SignalHandlerOptions
        except ImportError as error:
            raise ConfigError(
                f'a route says through = "rclpy", but rclpy cannot be imported ({error}); run: '
                "source /opt/ros/<distribution>/setup.bash, or pip install 'ros-jazzy-rclpy[fastrtps]'"
            ) from None
        self.number = number
        self._closed = threading.Event()
        self._context = Context()
        try:
            rclpy.init(
                args=_NO_LOG_FILES,
                context=self._context,
                domain_id=number,
                signal_handler_options=SignalHandlerOptions.NO,
            )
            self.node = rclpy.create_node(
                f"{NODE_PREFIX}{uuid.uuid4().hex[:12]}",
                context=self._context,
                use_global_arguments=False,
                enable_rosout=False,
                start_parameter_services=False,
                parameter_overrides=[Parameter("start_type_description_service", value=False)],
            )
        except Exception as error:  # rclpy has no common class of errors
            self._context.try_shutdown()
            raise ConfigError(f"rclpy cannot join domain {number}: {_line(error)}") from None
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._run, name=f"rclpy-domain-{number}", daemon=True)
        self._thread.start()

    def other_proxy_serves(self, service: str) -> bool:
        """Does another proxy, through rclpy as well, bring this service to the domain?"""
        for name, namespace in self.node.get_node_names_and_namespaces():
            if name.startswith(NODE_PREFIX) and name != self.node.get_name():
                try:
                    services = self.node.get_service_names_and_types_by_node(name, namespace)
                except Exception:  # it has left already; the class of the error depends on the distribution
                    continue
                if service in (found for found, _ in services):
                    return True
        return False

    def close(self) -> None:
        """Leave the domain."""
        self._closed.set()
        self._executor.shutdown(timeout_sec=5.0)
        self._thread.join(5.0)
        self.node.destroy_node()
        self._context.try_shutdown()

    def _run(self) -> None:
        while self._context.ok() and not self._closed.is_set():
            try:
                self._executor.spin()
            except Exception:  # one service's trouble is not the others'
                if not self._closed.wait(_PAUSE):
                    log.exception("domain %d, rclpy", self.number)


def service_type(name: str) -> Any:
    """The class of a service, such as std_srvs/srv/SetBool, or of an action's, such as pkg/action/Fold_SendGoal.

    Raises:
        ConfigError: it is not installed here, or not a service.
    """
    package, kind, base = name.split("/")
    try:
        if kind == "action":
            base, _, part = base.rpartition("_")
            return getattr(getattr(importlib.import_module(f"{package}.action"), base).Impl, _PARTS[part])
        return getattr(importlib.import_module(f"{package}.srv"), base)
    except (ImportError, AttributeError, KeyError):
        raise ConfigError(
            f"the type {name} is not installed where this proxy runs; rclpy needs its package, {package}"
        ) from None


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
