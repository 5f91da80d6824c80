"""The gRPC gateway, with code that protoc made of tutelage.proto, as a program in another language would have it."""

from __future__ import annotations

import contextlib
import datetime
import ipaddress
import sys
import threading
from pathlib import Path

import grpc
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from grpc import StatusCode
from sgc.fleets import service, topic
from sgc.proxies.ros_ends import cdr, until

from tutelage.errors import ConfigError
from tutelage.sgc.proxies import grpc_messages
from tutelage.sgc.proxies.grpc import Gateway
from tutelage.sgc.proxies.latched import Retained
from tutelage.sgc.proxies.listen import Tls
from tutelage.sgc.service import RequestFailed

POLICY = (
    topic("chat", ["robot", "app"], ["robot", "app"])
    + topic("telemetry", ["robot"], ["app"], delivery="lossy")
    + service("grasp", ["robot"], ["app"])
    + service("plan", ["app"], ["robot"])
)
PROTO = Path(grpc_messages.__file__).with_name("tutelage.proto")
TOKEN = "0123456789abcdef"


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    """Client code as protoc generates it."""
    from grpc_tools import protoc

    folder = tmp_path_factory.mktemp("generated")
    arguments = ["protoc", f"-I{PROTO.parent}", f"--python_out={folder}", f"--grpc_python_out={folder}", PROTO.name]
    assert protoc.main(arguments) == 0
    sys.path.insert(0, str(folder))
    import tutelage_pb2
    import tutelage_pb2_grpc

    yield tutelage_pb2, tutelage_pb2_grpc
    sys.path.remove(str(folder))


class Client:
    def __init__(self, generated, channel) -> None:
        self.pb, services = generated
        self.channel = channel
        self.stub = services.GatewayStub(channel)

    def subscribe(self, alias, **fields):
        """The stream, once the gateway has subscribed."""
        stream = self.stub.Subscribe(self.pb.SubscribeRequest(topic=alias, **fields))
        stream.initial_metadata()
        return stream

    def publish(self, alias, payload):
        return self.stub.Publish(self.pb.PublishRequest(topic=alias, payload=payload))


@pytest.fixture
def setting(company, generated):
    robot, app = company(POLICY, "robot", "app")
    with Gateway(app, listen="127.0.0.1:0") as gateway, grpc.insecure_channel(gateway.address) as channel:
        yield robot, gateway, Client(generated, channel)


def refused(call):
    with pytest.raises(grpc.RpcError) as caught:
        call()
    return caught.value.code(), caught.value.details()


def test_the_compiled_descriptor_is_that_of_the_proto_file(tmp_path):
    from grpc_tools import protoc

    made = tmp_path / "made.binpb"
    assert protoc.main(["protoc", f"-I{PROTO.parent}", f"--descriptor_set_out={made}", PROTO.name]) == 0
    assert made.read_bytes() == grpc_messages.descriptor(), "compile it again, as grpc_messages.py says"


def test_messages_go_both_ways(setting):
    robot, _, client = setting
    heard = []
    robot.subscribe("chat", heard.append)
    stream = client.subscribe("chat")
    assert client.publish("chat", b"from the app").sent == 1
    assert until(lambda: heard)
    assert (heard[0].payload, heard[0].sender) == (b"from the app", "app")
    robot.publisher("chat").send(b"from the robot")
    messages = [next(stream) for _ in range(2)]
    message = next(message for message in messages if message.sender == "robot")
    assert (message.topic, message.payload, message.authentic) == ("chat", b"from the robot", True)
    assert message.sequence >= 1
    assert 0 <= message.received - message.sent < 5
    stream.cancel()


def test_1000_messages_in_order_each_way_as_streams(setting):
    robot, _, client = setting
    heard = []
    robot.subscribe("chat", lambda message: heard.append(message.payload))
    payloads = [str(i).encode() for i in range(1000)]
    requests = (client.pb.PublishRequest(topic="chat", payload=payload) for payload in payloads)
    assert client.stub.PublishStream(requests).sent == 1000
    assert until(lambda: len(heard) == 1000)
    assert heard == payloads
    stream = client.subscribe("chat")
    threading.Thread(target=lambda: [robot.publisher("chat").send(payload, wait=5.0) for payload in payloads]).start()
    assert [next(stream).payload for _ in payloads] == payloads
    stream.cancel()


def test_14_mb_pass(setting, generated):
    robot, gateway, _ = setting
    with grpc.insecure_channel(gateway.address, options=[("grpc.max_receive_message_length", -1)]) as channel:
        stream = Client(generated, channel).subscribe("chat")
        robot.publisher("chat").send(bytes(14_000_000))
        assert len(next(stream).payload) == 14_000_000
        stream.cancel()


def test_a_slow_reader_of_a_reliable_topic_misses_nothing(setting):
    robot, _, client = setting
    stream = client.subscribe("chat", queue=2)
    payloads = [bytes([i]) * 100_000 for i in range(100)]
    threading.Thread(target=lambda: [robot.publisher("chat").send(payload, wait=20.0) for payload in payloads]).start()
    assert [next(stream).payload for _ in payloads] == payloads
    stream.cancel()


def test_repetitions_of_latched_messages_come_once(setting):
    robot, _, client = setting
    retained = Retained(2, robot.publisher("chat").send)
    retained.send(cdr("std_msgs/msg/String", data="before"))
    stream = client.subscribe("chat")
    for _ in range(2):
        retained._due = [0.0]
        retained.tend(frozenset())
    retained.send(cdr("std_msgs/msg/String", data="after"))
    payloads = [next(stream).payload]
    while payloads[-1] != cdr("std_msgs/msg/String", data="after"):
        payloads.append(next(stream).payload)
    assert payloads == [cdr("std_msgs/msg/String", data=text) for text in ("before", "after")]
    stream.cancel()


def test_a_service_of_the_fleet_is_asked(setting):
    robot, _, client = setting

    def grasp(message):
        if message.payload == b"impossible":
            raise ValueError("cannot reach it")
        return message.payload[::-1]

    robot.serve("grasp", grasp)
    ask = client.stub.Request
    assert ask(client.pb.ServiceRequest(service="grasp", payload=b"abc")).payload == b"cba"
    code, details = refused(lambda: ask(client.pb.ServiceRequest(service="grasp", payload=b"impossible")))
    assert code == StatusCode.ABORTED
    assert "cannot reach it" in details


def test_a_program_answers_for_a_service(setting):
    robot, gateway, client = setting
    answers = AnswerQueue(client.pb.Answer(service="plan", timeout=1.0))
    calls = client.stub.Serve(answers)
    calls.initial_metadata()

    def work():
        with contextlib.suppress(grpc.RpcError):  # cancelled at the end
            for call in calls:
                answer(call)

    def answer(call):
        if call.payload == b"fail":
            answers.put(client.pb.Answer(id=call.id, error="no plan"))
        elif call.payload != b"silence":
            answers.put(client.pb.Answer(id=call.id, payload=call.sender.encode() + call.payload))

    thread = threading.Thread(target=work)
    thread.start()
    assert robot.request("plan", b"!", timeout=5.0) == b"robot!"
    with pytest.raises(RequestFailed, match="no plan"):
        robot.request("plan", b"fail", timeout=5.0)
    with pytest.raises(RequestFailed, match="took longer than 1 s"):
        robot.request("plan", b"silence", timeout=5.0)
    second = client.stub.Serve(iter([client.pb.Answer(service="plan")]))
    assert refused(lambda: next(second))[0] == StatusCode.ALREADY_EXISTS
    calls.cancel()
    thread.join(5.0)
    assert until(lambda: not gateway._calls._serving)


class AnswerQueue:
    """An iterator that a test fills."""

    def __init__(self, first) -> None:
        self._items, self._changed = [first], threading.Condition()

    def put(self, item) -> None:
        with self._changed:
            self._items.append(item)
            self._changed.notify()

    def __iter__(self):
        return self

    def __next__(self):
        with self._changed:
            self._changed.wait_for(lambda: self._items)
            return self._items.pop(0)


def test_peers_and_what_one_may_do(setting):
    _, _, client = setting
    reply = until(lambda: (found := client.stub.Peers(client.pb.PeersRequest())).peers and found)
    assert reply.node == "app"
    assert [peer.name for peer in reply.peers] == ["robot"]
    assert reply.peers[0].round_trip > 0
    plan = next(topic for topic in reply.topics if topic.alias == "plan")
    assert (plan.service, plan.may_send, plan.may_receive, plan.interface) == (True, False, True, "/plan")


@pytest.mark.parametrize(
    ("call", "code", "says"),
    [
        (lambda c: c.publish("telemetry", b""), StatusCode.PERMISSION_DENIED, "app"),
        (lambda c: c.publish("secret", b""), StatusCode.PERMISSION_DENIED, "secret"),
        (lambda c: c.publish("grasp", b""), StatusCode.PERMISSION_DENIED, "grasp is a service"),
        (lambda c: next(c.stub.Subscribe(c.pb.SubscribeRequest(topic="x"))), StatusCode.PERMISSION_DENIED, "'x'"),
        (
            lambda c: next(c.stub.Subscribe(c.pb.SubscribeRequest(topic="chat", queue=10**9))),
            StatusCode.INVALID_ARGUMENT,
            "10000 messages at most",
        ),
        (
            lambda c: c.stub.PublishStream(iter([c.pb.PublishRequest(topic="telemetry")])),
            StatusCode.PERMISSION_DENIED,
            "telemetry",
        ),
        (lambda c: c.stub.Request(c.pb.ServiceRequest(service="plan")), StatusCode.PERMISSION_DENIED, "plan"),
        (
            lambda c: c.stub.Request(c.pb.ServiceRequest(service="grasp", timeout=0.2)),
            StatusCode.DEADLINE_EXCEEDED,
            "grasp",
        ),
        (lambda c: next(c.stub.Serve(iter([c.pb.Answer(service="grasp")]))), StatusCode.PERMISSION_DENIED, "grasp"),
        (lambda c: next(c.stub.Serve(iter([]))), StatusCode.PERMISSION_DENIED, "''"),
    ],
)
def test_what_is_not_allowed_or_not_there_is_a_status_that_names_it(setting, call, code, says):
    found, details = refused(lambda: call(setting[2]))
    assert found == code, details
    assert says in details


@pytest.mark.parametrize("payload", [b"\xff", b"\x0a\xff\xff\xff\xff\xff", b"\x08" * 1000])
def test_bytes_that_are_no_message_are_refused_and_the_gateway_lives(setting, payload):
    _, _, client = setting
    raw = client.channel.unary_unary("/tutelage.sgc.v1.Gateway/Publish")
    with pytest.raises(grpc.RpcError):
        raw(payload)
    assert client.publish("chat", b"still here").sent == 1


def test_a_unix_socket_serves_too(company, generated, tmp_path):
    _, app = company(POLICY, "robot", "app")
    address = f"unix:{tmp_path}/gateway.sock"
    with Gateway(app, listen=address), grpc.insecure_channel(address) as channel:
        assert Client(generated, channel).publish("chat", b"x").sent == 1


def test_a_token_is_needed_where_one_is_set(company, generated):
    _, app = company(POLICY, "robot", "app")
    with Gateway(app, listen="127.0.0.1:0", token=TOKEN) as gateway, grpc.insecure_channel(gateway.address) as channel:
        client = Client(generated, channel)
        request = client.pb.PublishRequest(topic="chat", payload=b"x")
        for metadata in ((), (("authorization", "Bearer wrong"),)):
            assert (
                refused(lambda metadata=metadata: client.stub.Publish(request, metadata=metadata))[0]
                == StatusCode.UNAUTHENTICATED
            )
        assert (
            refused(lambda: next(client.stub.Subscribe(client.pb.SubscribeRequest(topic="chat"))))[0]
            == StatusCode.UNAUTHENTICATED
        )
        assert client.stub.Publish(request, metadata=(("authorization", f"Bearer {TOKEN}"),)).sent == 1


def _certificates(folder):
    """An authority, and certificates of it for a server and a client, as files."""
    now = datetime.datetime.now(datetime.UTC)

    def make(name, issuer_key, issuer):
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        loopback = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
        certificate = (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(issuer or subject)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(hours=1))
            .not_valid_after(now + datetime.timedelta(hours=1))
            .add_extension(x509.BasicConstraints(issuer is None, None), critical=True)
            .add_extension(loopback, critical=False)
            .sign(issuer_key or key, hashes.SHA256())
        )
        (folder / f"{name}.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
        private = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        (folder / f"{name}.key").write_bytes(key.private_bytes(serialization.Encoding.PEM, *private))
        return key, subject

    authority = make("authority", None, None)
    for name in ("server", "client"):
        make(name, *authority)


def test_files_that_cannot_serve_for_tls_are_named(company, tmp_path):
    _certificates(tmp_path)
    _, app = company(POLICY, "robot", "app")
    server, key, junk = tmp_path / "server.pem", tmp_path / "server.key", tmp_path / "junk"
    junk.write_text("junk")
    with pytest.raises(ConfigError, match=r"cannot use \S+junk with \S+server.key"):
        Gateway(app, tls=Tls(junk, key))
    with pytest.raises(ConfigError, match=r"cannot use \S+junk as an authority"):
        Gateway(app, tls=Tls(server, key, junk))
    with pytest.raises(ConfigError, match=r"leaf.pem is Ed25519, .*; use ECDSA or RSA"):
        Gateway(app, tls=Tls(app.home.leaf_file, app.home.key_file))
    locked = serialization.load_pem_private_key(key.read_bytes(), None).private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.BestAvailableEncryption(b"secret")
    )
    key.write_bytes(locked)
    with pytest.raises(ConfigError, match=r"cannot use \S+server.pem with \S+server.key"):  # and nobody is asked
        Gateway(app, tls=Tls(server, key))
    with pytest.raises(ConfigError, match="names no socket; write unix:PATH"):
        Gateway(app, listen="unix:")


def test_tls_with_certificates_of_the_clients(company, generated, tmp_path):
    _certificates(tmp_path)
    _, app = company(POLICY, "robot", "app")
    tls = Tls(tmp_path / "server.pem", tmp_path / "server.key", tmp_path / "authority.pem")

    def read(name):
        return (tmp_path / name).read_bytes()

    with Gateway(app, listen="127.0.0.1:0", tls=tls) as gateway:
        known = grpc.ssl_channel_credentials(read("authority.pem"), read("client.key"), read("client.pem"))
        with grpc.secure_channel(gateway.address, known) as channel:
            assert Client(generated, channel).publish("chat", b"x").sent == 1
        stranger = grpc.ssl_channel_credentials(read("authority.pem"))
        with grpc.secure_channel(gateway.address, stranger) as channel:
            assert refused(lambda: Client(generated, channel).publish("chat", b"x"))[0] == StatusCode.UNAVAILABLE


def test_off_loopback_it_wants_protection_and_says_what_it_cannot_use(company, tmp_path):
    _, app = company(POLICY, "robot", "app")
    with pytest.raises(ConfigError, match="needs TLS"):
        Gateway(app, listen="0.0.0.0:0", token=TOKEN)
    tls = Tls(tmp_path / "none.pem", tmp_path / "none.key")
    with pytest.raises(ConfigError, match="needs a token or an authority"):
        Gateway(app, listen="0.0.0.0:0", tls=tls)
    with pytest.raises(ConfigError, match=r"cannot read .*none.pem"):
        Gateway(app, listen="127.0.0.1:0", tls=tls)
    with pytest.raises(ConfigError, match="is no address"):
        Gateway(app, listen="50051")
    with Gateway(app, listen="127.0.0.1:0") as gateway, pytest.raises(ConfigError, match="cannot listen"):
        Gateway(app, listen=gateway.address)
