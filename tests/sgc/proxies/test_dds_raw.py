"""Serialized samples over DDS, bytes unchanged, without knowing the type."""

from __future__ import annotations

import pytest
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from sgc.proxies.ros_ends import RELIABLE, STRING, RosNode, String, cdr, taken, until

from tutelage.sgc.proxies import dds_raw
from tutelage.sgc.proxies.ros_names import topic_channel

CHANNEL = topic_channel("/chatter", STRING)


def raw_pair(domain):
    one, other = RosNode(domain), RosNode(domain)
    writer = DataWriter(one.participant, dds_raw.raw_topic(one.participant, CHANNEL), qos=RELIABLE)
    reader = DataReader(other.participant, dds_raw.raw_topic(other.participant, CHANNEL), qos=RELIABLE)
    assert until(writer.get_matched_subscriptions)
    return writer, reader


def received(reader):
    return until(lambda: dds_raw.take(reader))


@pytest.mark.parametrize("length", [0, 1, 2, 3, 4, 1000, 3_000_000])
def test_bytes_arrive_as_they_were_written_whatever_their_length(domains, length):
    writer, reader = raw_pair(next(domains))
    data = cdr(STRING, data="x" * length)
    assert dds_raw.write(writer, data)
    assert [sample.data for sample in received(reader)] == [data]


def test_pieces_are_joined(domains):
    writer, reader = raw_pair(next(domains))
    assert dds_raw.write(writer, b"\0\1\0\0", b"abcd", b"efg")
    assert received(reader)[0].data == b"\0\1\0\0abcdefg"


def test_typed_peers_match_by_the_name_of_the_type_in_both_directions(domains):
    domain = next(domains)
    writer, reader = raw_pair(domain)
    typed = RosNode(domain)
    sends, hears = typed.publisher("/chatter"), typed.subscription("/chatter")
    assert until(lambda: sends.get_matched_subscriptions() and len(writer.get_matched_subscriptions()) == 2)
    sends.write(String("typed"))
    assert received(reader)[0].data.rstrip(b"\0") == cdr(STRING, data="typed").rstrip(b"\0")
    dds_raw.write(writer, cdr(STRING, data="raw"))
    assert "raw" in taken(hears, 2)


@pytest.mark.parametrize("data", [b"", b"\0", b"\0\1\0", b"\0\1\0\0", b"\xff\xff\0\0abcd", b"\0\3\0\0abcd", b"\0\1\0\3a"])
def test_what_is_no_serialized_message_is_refused_and_nothing_is_sent(domains, data):
    writer, reader = raw_pair(next(domains))
    with pytest.raises(ValueError, match="not a serialized message"):
        dds_raw.write(writer, data)
    dds_raw.write(writer, cdr(STRING, data="after"))
    assert [sample.data for sample in received(reader)] == [cdr(STRING, data="after")]


def test_a_closed_reader_or_writer_is_an_error_not_a_crash(domains):
    writer, reader = raw_pair(next(domains))
    writer.__del__()
    reader.__del__()
    with pytest.raises(OSError):
        dds_raw.write(writer, cdr(STRING, data="x"))
    with pytest.raises(OSError):
        dds_raw.take(reader)
