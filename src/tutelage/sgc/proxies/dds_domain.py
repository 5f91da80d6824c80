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

from tutelage.errors import MissingExtraError
from tutelage.sgc.proxies import dds_raw
from tutelage.sgc.proxies.ros_names import Channel
from tutelage.sgc.proxies.ros_qos import QosProfile

log = logging.getLogger(__name__)
MARK = "tutelage"
"""Key in the USER_DATA of what a proxy writes. No proxy takes what a proxy has written, so nothing goes round in circles."""
_NO_TIME = 2**63 - 1  # DDS's infinity, nanoseconds
_WRITE_TIMEOUT = 100_000_000  # nanoseconds that a reliable writer may wait for slow readers


def user_data(pairs: dict[str, str]) -> bytes:
    """USER_DATA as the middlewares of ROS 2 write it: key=value;key=value;"""
    return "".join(f"{key}={value};" for key, value in pairs.items()).encode()


def parse_user_data(data: bytes) -> dict[str, str]:
    """The other way round; what is not of that form is left out."""
    pairs = (part.partition("=") for part in data.decode("utf-8", "replace").split(";"))
    return {key: value for key, equals, value in pairs if equals}


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
        self.dds = DataReader(domain.participant, domain.topic(channel), qos=_dds_qos(qos, pairs, writes=False))
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
        while self._deliver.ready():
            samples = dds_raw.take(self.dds)
            for sample in samples:
                if self._from_proxy(sample.writer):
                    self.ignored += 1
                else:
                    self._deliver.put(sample.data)
            if not samples:
                return

    @property
    def matched(self) -> int:
        """How many writers there are."""
        return len(self.dds.get_matched_publications())

    @property
    def ready(self) -> bool:
        """Is there room for more?"""
        return self._deliver.ready()

    def _from_proxy(self, writer: int) -> bool:
        known = self._proxies.get(writer)
        if known is None:
            known = self._proxies[writer] = bool(self._mark_of(writer))
            if len(self._proxies) > 10_000:  # writers come and go for months
                self._proxies = {writer: known}
        return known

    def _mark_of(self, writer: int) -> str:
        from cyclonedds.core import DDSException

        try:
            found = self.dds.get_matched_publication_data(writer)
        except DDSException:  # it has left already; it is taken for an application
            return ""
        return _mark(found.qos) if found is not None else ""


class _Deliver:
    """What a reader's samples go to: `put` each; `ready` says whether it has room."""

    def __init__(self, put: Callable[[bytes], None], ready: Callable[[], bool]) -> None:
        self.put, self.ready = put, ready


class Writer:
    """A DDS writer of serialized samples."""

    def __init__(self, domain: Domain, channel: Channel, qos: QosProfile, pairs: dict[str, str]) -> None:
        from cyclonedds.pub import DataWriter

        self.channel = channel
        marked = {**pairs, MARK: domain.mark}
        self.dds = DataWriter(domain.participant, domain.topic(channel), qos=_dds_qos(qos, marked, writes=True))

    def write(self, *parts: bytes) -> bool:
        """Write one sample given in pieces; see `dds_raw.write`."""
        return dds_raw.write(self.dds, *parts)

    @property
    def matched(self) -> int:
        """How many readers there are."""
        return len(self.dds.get_matched_subscriptions())


class Domain:
    """A participant of one DDS domain. Which network interfaces it uses is Cyclone DDS's own matter (CYCLONEDDS_URI).

    Args:
        number: of the domain, ROS_DOMAIN_ID.
        mark: identifies the proxy to others, from which domain ever; no secret.
    """

    def __init__(self, number: int, mark: str = "") -> None:
        try:
            from cyclonedds.core import GuardCondition, WaitSet
            from cyclonedds.domain import DomainParticipant
        except ImportError:
            raise MissingExtraError("cyclonedds", "ros2") from None
        self.number = number
        self.mark = mark or uuid.uuid4().hex
        self.participant = DomainParticipant(number)
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
        ready: Callable[[], bool] = lambda: True,
        pairs: dict[str, str] | None = None,
    ) -> Reader:
        """Read a topic: `put` gets each sample that no proxy has written, on the domain's thread, so it must not block.

        ready: while it is false, samples stay with DDS; `wake` tells that it has become true.
        pairs: for USER_DATA.
        """
        reader = Reader(self, channel, qos, pairs or {}, _Deliver(put, ready))
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
                except OSError as error:
                    if not self._stop:
                        log.error("domain %d, %s: %s", self.number, reader.channel.topic, error)


def _mark(qos: Any) -> str:
    from cyclonedds.core import Policy

    policy = qos[Policy.Userdata] if Policy.Userdata in qos else None  # noqa: SIM401 - a Qos has no get
    return parse_user_data(bytes(policy.data)).get(MARK, "") if policy is not None else ""


def _dds_qos(profile: QosProfile, pairs: dict[str, str], *, writes: bool) -> Any:
    """The profile as Cyclone DDS's. Lifespan and deadline are promises of writers; a reader that asks for none fits all."""
    from cyclonedds.core import Policy, Qos

    keep_all = profile.history == "keep_all"
    history = Policy.History.KeepAll if keep_all else Policy.History.KeepLast(profile.depth)
    reliable = profile.reliability == "reliable"
    policies: list[Any] = [
        history,
        Policy.Reliability.Reliable(_WRITE_TIMEOUT) if reliable else Policy.Reliability.BestEffort,
        Policy.Userdata(user_data(pairs)),
        Policy.IgnoreLocal.Participant,
    ]
    if profile.durability == "transient_local":
        policies += [Policy.Durability.TransientLocal, Policy.DurabilityService(0, history, -1, -1, -1)]
    if writes:
        policies.append(Policy.WriterDataLifecycle(autodispose=False))
        if profile.lifespan is not None:
            policies.append(Policy.Lifespan(round(profile.lifespan * 1e9)))
        if profile.deadline is not None:
            policies.append(Policy.Deadline(round(profile.deadline * 1e9)))
    return Qos(*policies)
