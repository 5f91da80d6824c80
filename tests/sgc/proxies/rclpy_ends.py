"""ROS 2 nodes of rclpy, each in a process of its own, under the middleware that is installed; messages are rclpy's own."""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections import defaultdict
from multiprocessing.managers import BaseManager
from typing import Any


class _Node:
    """In the other process."""

    def __init__(self, domain: int, name: str) -> None:
        import rclpy
        from rclpy.executors import MultiThreadedExecutor

        rclpy.init(args=[], domain_id=domain)
        self._node = rclpy.create_node(name)
        self._publishers: dict[str, Any] = {}
        self._heard: defaultdict[str, list[Any]] = defaultdict(list)
        self._asked: defaultdict[str, list[Any]] = defaultdict(list)
        self._clients: dict[str, Any] = {}
        self._subscriptions: list[Any] = []
        self._executor = MultiThreadedExecutor(8)
        self._executor.add_node(self._node)
        threading.Thread(target=self._executor.spin, daemon=True).start()

    def subscribe(self, name: str, kind: Any, **qos: Any) -> None:
        """qos: policies of `QoSProfile`, as text where they are enumerations."""
        self._subscriptions.append(self._node.create_subscription(kind, name, self._heard[name].append, _qos(**qos)))

    def heard(self, name: str, count: int = 0, timeout: float = 20.0) -> list[Any]:
        """What has come, once it is as many, or time is over."""
        end = time.monotonic() + timeout
        while len(self._heard[name]) < count and time.monotonic() < end:
            time.sleep(0.01)
        return list(self._heard[name])

    def advertise(self, name: str, kind: Any, **qos: Any) -> None:
        self._publishers[name] = self._node.create_publisher(kind, name, _qos(**qos))

    def publish(self, name: str, messages: list[Any]) -> None:
        for message in messages:
            self._publishers[name].publish(message)

    def subscribers(self, name: str) -> int:
        """How many subscriptions this node's publisher has found."""
        return int(self._publishers[name].get_subscription_count())

    def hears(self, name: str) -> int:
        """How many publishers this node's subscriptions have found: what others have sent before is lost."""
        return sum(one.get_publisher_count() for one in self._subscriptions if one.topic_name == name)

    def publishers(self, name: str) -> list[dict[str, Any]]:
        """What ROS 2 knows of a topic's publishers."""
        found = self._node.get_publishers_info_by_topic(name)
        return [
            {
                "node": end.node_name,
                "type": end.topic_type,
                "hash": str(end.topic_type_hash),
                "reliability": end.qos_profile.reliability.name.lower(),
                "durability": end.qos_profile.durability.name.lower(),
            }
            for end in found
        ]

    def topics(self) -> dict[str, list[str]]:
        return dict(self._node.get_topic_names_and_types())

    def nodes(self) -> list[str]:
        return list(self._node.get_node_names())

    def parameter(self, name: str, value: Any = None) -> Any:
        """Declare it with a value, or look at it."""
        if value is not None:
            self._node.declare_parameter(name, value)
        return self._node.get_parameter(name).value

    def serve(self, name: str, kind: Any, delay: float = 0.0, **answer: Any) -> None:
        """Reply with these fields, and the request's of the same name, after some seconds; see `asked`."""
        from rclpy.callback_groups import ReentrantCallbackGroup

        def reply(request: Any, response: Any) -> Any:
            self._asked[name].append(request)
            time.sleep(delay)
            for field in request.get_fields_and_field_types():
                if field in response.get_fields_and_field_types():
                    setattr(response, field, getattr(request, field))
            for field, value in answer.items():
                setattr(response, field, value)
            return response

        self._node.create_service(kind, name, reply, callback_group=ReentrantCallbackGroup())

    def asked(self, name: str) -> list[Any]:
        return list(self._asked[name])

    def call(self, name: str, kind: Any, request: Any, timeout: float = 10.0, *, insist: bool = False) -> Any:
        """The reply; None if there is no server, or it does not answer in time. insist: ask though no server is seen."""
        if name not in self._clients:
            self._clients[name] = self._node.create_client(kind, name)
        client = self._clients[name]
        if not insist and not client.wait_for_service(timeout):
            return None
        return client.call(request, timeout)

    def serve_fibonacci(self, name: str, pause: float) -> None:
        """An action server that adds a number each `pause` seconds, says so, and can be cancelled."""
        from rclpy.action import ActionServer, CancelResponse
        from rclpy.callback_groups import ReentrantCallbackGroup
        from test_msgs.action import Fibonacci

        def execute(goal: Any) -> Any:
            sequence = [0, 1]
            while len(sequence) <= goal.request.order:
                if goal.is_cancel_requested:
                    goal.canceled()
                    return Fibonacci.Result(sequence=sequence)
                sequence.append(sequence[-2] + sequence[-1])
                goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
                time.sleep(pause)
            goal.succeed()
            return Fibonacci.Result(sequence=sequence)

        self._server = ActionServer(
            self._node,
            Fibonacci,
            name,
            execute,
            callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )

    def use_fibonacci(self, name: str) -> None:
        """Become an action client."""
        from rclpy.action import ActionClient
        from test_msgs.action import Fibonacci

        self._fibonacci = ActionClient(self._node, Fibonacci, name)

    def fibonacci(self, order: int, cancel_after: int = 0) -> tuple[int, list[int], list[int]]:
        """Status, result and lengths of the feedback of a goal; cancelled after so many messages of feedback, 0: never."""
        from test_msgs.action import Fibonacci

        lengths: list[int] = []
        enough = threading.Event()

        def on_feedback(message: Any) -> None:
            lengths.append(len(message.feedback.sequence))
            if len(lengths) == cancel_after:
                enough.set()

        def wait(future: Any) -> Any:
            done = threading.Event()
            future.add_done_callback(lambda _: done.set())
            assert done.wait(20.0), "no reply"
            return future.result()

        assert self._fibonacci.wait_for_server(20.0), "no server"
        goal = wait(self._fibonacci.send_goal_async(Fibonacci.Goal(order=order), feedback_callback=on_feedback))
        assert goal.accepted
        result = goal.get_result_async()
        if cancel_after:
            assert enough.wait(20.0), "no feedback"
            assert len(wait(goal.cancel_goal_async()).goals_canceling) == 1
        answer = wait(result)
        return int(answer.status), list(answer.result.sequence), lengths


def _qos(depth: int = 400, reliability: str = "RELIABLE", durability: str = "VOLATILE") -> Any:
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(depth=depth, reliability=ReliabilityPolicy[reliability], durability=DurabilityPolicy[durability])


class _Process(BaseManager):
    """Runs a `_Node` for another process."""


_Process.register("Node", _Node)


class RosNodes:
    """`nodes(domain, name)` starts a node in a process of its own; all end with the test."""

    def __init__(self) -> None:
        self._processes: list[_Process] = []

    def __call__(self, domain: int, name: str) -> Any:
        process = _Process(ctx=multiprocessing.get_context("spawn"))
        process.start()
        self._processes.append(process)
        return process.Node(domain, name)  # type: ignore[attr-defined]

    def close(self) -> None:
        for process in self._processes:
            process.shutdown()
