"""One DDS domain of a proxy: a participant, readers that one thread empties, writers, and who else is there.

Samples are taken by a thread that waits on all readers, never in a listener: a listener runs on the receiving thread of the
DDS library, and forwarding there stops it.
"""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import Callable
from typing import Any

from tutelage.errors import ConfigError, MissingExtraError
from tutelage.sgc.proxies import dds_raw
from tutelage.sgc.proxies.dds_qos import MARK, dds_qos, mark_of, policy_name
from tutelage.sgc.proxies.ros_names import Channel
from tutelage.sgc.proxies.ros_qos import QosProfile

log = logging.getLogger(__name__)
_NO_TIME = 2**63 - 1  # DDS's infinity, nanoseconds
_AT_ONCE = 16


class Reader:
    """A DDS reader that a `Domain` empties into `on_sample`.

    Attributes:
        ignored: samples that were left where they were, as a proxy had written them.
    """

    def __init__(self, domain: Domain, channel: Channel, qos: QosProfile, pairs: dict[str, str], deliver: _Deliver) -> None:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader

        self.channel = channel
        self.ignored = 0
        self._deliver = deliver
        self._proxies: dict[int, bool] = {}
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
                if self._from_proxy(sample.writer):
                    self.ignored += 1
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

    def _from_proxy(self, writer: int) -> bool:
        known = self._proxies.get(writer)
        if known is None:
            known = self._proxies[writer] = bool(self._mark_of(writer))
            if known:
                log.warning(
                    "another proxy writes %s here; if it brings the same, everything comes twice", self.channel.topic
                )
            if len(self._proxies) > 10_000:  # writers come and go for months
                self._proxies = {writer: known}
        return known

    def _mark_of(self, writer: int) -> str:
        from cyclonedds.core import DDSException

        try:
            found = self.dds.get_matched_publication_data(writer)
        except DDSException:  # it has left already; it is taken for an application
            return ""
        return mark_of(found.qos) if found is not None else ""


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
    ) -> Reader:
        """Read a topic: `put` gets each sample that no proxy has written, on the domain's thread, so it must not block.

        room: for how many samples there is room; others stay with DDS. `wake` tells that there is room again.
        pairs: for USER_DATA.
        """
        reader = Reader(self, channel, qos, pairs or {}, _Deliver(put, room))
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
