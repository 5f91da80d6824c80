"""One DDS domain of a proxy: a participant, readers that one thread empties, writers, and who else is there.

Samples are taken by a thread that waits on all readers, never in a listener: a listener runs on the receiving thread of the
DDS library, and forwarding there stops it.
"""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import Callable
from enum import Enum, auto
from typing import Any

from tutelage.errors import ConfigError, MissingExtraError
from tutelage.sgc.proxies import dds_raw
from tutelage.sgc.proxies.dds_qos import MARK, dds_qos, mark_of, policy_name
from tutelage.sgc.proxies.ros_names import Channel
from tutelage.sgc.proxies.ros_qos import QosProfile

log = logging.getLogger(__name__)
_NO_TIME = 2**63 - 1  # DDS's infinity, nanoseconds
_AT_ONCE = 16
_CYCLONE = b"\x01\x10"
"""Vendor, the first bytes of the identity (GUID) of whatever Cyclone DDS has made."""


class Reader:
    """A DDS reader that a `Domain` empties into `on_sample`.

    Attributes:
        ignored: samples that were left where they were, as a proxy had written them.
        foreign: samples of another vendor's that were left, with `cyclone_only`.
    """

    def __init__(
        self,
        domain: Domain,
        channel: Channel,
        qos: QosProfile,
        pairs: dict[str, str],
        deliver: _Deliver,
        cyclone_only: bool,
    ) -> None:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader

        self.channel = channel
        self.ignored = self.foreign = 0
        self._deliver = deliver
        self._cyclone_only = cyclone_only
        self._writers: dict[int, _Origin] = {}
        self.dds = DataReader(domain.participant, domain.topic(channel), qos=dds_qos(qos, pairs, writes=False))
        self._condition = ReadCondition(self.dds, ViewState.Any | SampleState.Any | InstanceState.Any)
        self._waitset: Any = None

    def watch(self, waitset: Any, wanted: bool) -> None:
        """Let the waitset wake up for samples of this reader, or no longer."""
        if wanted and self._waitset is None:
            waitset.attach(self._condition)
            self._waitset = waitset
        elif not wanted and self._waitset is not None:
            self._waitset.detach(self._condition)
            self._waitset = None

    def drain(self) -> None:
        """Take all that is there, as long as it is wanted."""
        while room := self._deliver.room():
            samples = dds_raw.take(self.dds, min(room, _AT_ONCE))
            for sample in samples:
                origin = self._origin(sample.writer)
                if origin is _Origin.PROXY:
                    self.ignored += 1
                elif origin is _Origin.FOREIGN:
                    self.foreign += 1
                else:
                    self._deliver.put(sample.data)
            if not samples:
                return

    @property
    def incompatible(self) -> tuple[int, str]:
        """How many writers offer less than this asks for, and which policy of the last of them."""
        status = self.dds.get_requested_incompatible_qos_status()
        return status.total_count, policy_name(status.last_policy_id)

    @property
    def matched(self) -> int:
        """How many writers there are."""
        return len(self.dds.get_matched_publications())

    @property
    def ready(self) -> bool:
        """Is there room for more?"""
        return self._deliver.room() > 0

    def _origin(self, writer: int) -> _Origin:
        known = self._writers.get(writer)
        if known is None:
            known = self._writers[writer] = self._look_at(writer)
            if len(self._writers) > 10_000:  # writers come and go for months
                self._writers = {writer: known}
        return known

    def _look_at(self, writer: int) -> _Origin:
        from cyclonedds.core import DDSException

        try:
            found = self.dds.get_matched_publication_data(writer)
        except DDSException:  # it has left already; it is taken for an application
            return _Origin.APPLICATION
        if found is not None and mark_of(found.qos):
            log.warning("another proxy writes %s here; if it brings the same, everything comes twice", self.channel.topic)
            return _Origin.PROXY
        if found is not None and self._cyclone_only and not _is_cyclone(found):
            log.warning("%s: %s", self.channel.topic, OTHER_MIDDLEWARE)
            return _Origin.FOREIGN
        return _Origin.APPLICATION


class _Origin(Enum):
    APPLICATION = auto()
    PROXY = auto()
    FOREIGN = auto()


OTHER_MIDDLEWARE = (
    "a node uses another middleware than rmw_cyclonedds, whose services differ; "
    'say through = "rclpy" for the service in the file of routes'
)


def _is_cyclone(endpoint: Any) -> bool:
    return bool(endpoint.key.bytes[:2] == _CYCLONE)


class _Deliver:
    """What a reader's samples go to: `put` each; `room` says how many more it takes now."""

    def __init__(self, put: Callable[[bytes], None], room: Callable[[], int]) -> None:
        self.put, self.room = put, room


class Writer:
    """A DDS writer of serialized samples."""

    def __init__(self, domain: Domain, channel: Channel, qos: QosProfile, pairs: dict[str, str]) -> None:
        from cyclonedds.pub import DataWriter

        self.channel = channel
        marked = {**pairs, MARK: domain.mark}
        self.dds = DataWriter(domain.participant, domain.topic(channel), qos=dds_qos(qos, marked, writes=True))

    def write(self, *parts: bytes) -> bool:
        """Write one sample given in pieces; see `dds_raw.write`."""
        return dds_raw.write(self.dds, *parts)

    @property
    def incompatible(self) -> tuple[int, str]:
        """How many readers ask for more than this offers, and which policy of the last of them."""
        status = self.dds.get_offered_incompatible_qos_status()
        return status.total_count, policy_name(status.last_policy_id)

    @property
    def matched(self) -> int:
        """How many readers there are."""
        return len(self.dds.get_matched_subscriptions())

    @property
    def foreign(self) -> bool:
        """Is there a reader of another vendor than Cyclone DDS?"""
        from cyclonedds.core import DDSException

        for reader in self.dds.get_matched_subscriptions():
            try:
                found = self.dds.get_matched_subscription_data(reader)
            except DDSException:  # it has left already
                continue
            if found is not None and not _is_cyclone(found):
                return True
        return False


class Domain:
    """A participant of one DDS domain. Which network interfaces it uses is Cyclone DDS's own matter (CYCLONEDDS_URI).

    Args:
        number: of the domain, ROS_DOMAIN_ID.
        mark: identifies the proxy to others, from which domain ever; no secret.

    Raises:
        MissingExtraError: cyclonedds is not installed.
        ConfigError: Cyclone DDS cannot join, for instance as it finds no network interface.
    """

    def __init__(self, number: int, mark: str = "") -> None:
        try:
            from cyclonedds.core import DDSException, GuardCondition, WaitSet
            from cyclonedds.domain import DomainParticipant
        except ImportError:
            raise MissingExtraError("cyclonedds", "ros2") from None
        self.number = number
        self.mark = mark or uuid.uuid4().hex
        try:
            self.participant = DomainParticipant(number)
        except DDSException as error:
            raise ConfigError(f"DDS domain {number} cannot be joined ({error}); is CYCLONEDDS_URI right?") from None
        self._topics: dict[Channel, Any] = {}
        self._readers: list[Reader] = []
        self._lock = threading.Lock()
        self._waitset = WaitSet(self.participant)
        self._guard = GuardCondition(self.participant)
        self._waitset.attach(self._guard)
        self._stop = False
        self._thread = threading.Thread(target=self._run, name=f"dds-domain-{number}", daemon=True)
        self._thread.start()

    def topic(self, channel: Channel) -> Any:
        """The DDS topic; made on first use."""
        if channel not in self._topics:
            self._topics[channel] = dds_raw.raw_topic(self.participant, channel)
        return self._topics[channel]

    def reader(
        self,
        channel: Channel,
        qos: QosProfile,
        put: Callable[[bytes], None],
        *,
        room: Callable[[], int] = lambda: _AT_ONCE,
        pairs: dict[str, str] | None = None,
        cyclone_only: bool = False,
    ) -> Reader:
        """Read a topic: `put` gets each sample that no proxy has written, on the domain's thread, so it must not block.

        room: for how many samples there is room; others stay with DDS. `wake` tells that there is room again.
        pairs: for USER_DATA.
        cyclone_only: leave samples of other vendors, which have another form, as those of services.
        """
        reader = Reader(self, channel, qos, pairs or {}, _Deliver(put, room), cyclone_only)
        with self._lock:
            self._readers.append(reader)
        self.wake()
        return reader

    def writer(self, channel: Channel, qos: QosProfile, pairs: dict[str, str] | None = None) -> Writer:
        """Write a topic. pairs: for USER_DATA."""
        return Writer(self, channel, qos, pairs or {})

    def wake(self) -> None:
        """Look at the readers again."""
        self._guard.set(True)

    def close(self) -> None:
        """Leave the domain."""
        self._stop = True
        self.wake()
        self._thread.join(5.0)
        self._readers.clear()
        self._topics.clear()
        self.participant.__del__()  # now, not when the last reference goes: others on the domain are told at once

    def __enter__(self) -> Domain:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _run(self) -> None:
        while not self._stop:
            self._guard.set(False)  # first, so that no `wake` from here on is lost
            with self._lock:
                readers = tuple(self._readers)
            for reader in readers:
                reader.watch(self._waitset, reader.ready)
            self._waitset.wait(_NO_TIME)
            for reader in readers:
                try:
                    reader.drain()
                except Exception:  # one topic's trouble is not the others'
                    if not self._stop:
                        log.exception("domain %d, %s", self.number, reader.channel.topic)
