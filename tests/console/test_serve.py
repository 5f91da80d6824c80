"""`tutelage serve`, `tutelage accounts` and `tutelage audit` as a person runs them."""

from __future__ import annotations

import contextlib
import datetime
import ipaddress
import json
import re
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from consoles import PASSWORD
from websockets.sync.client import connect

from tutelage.console.audit import verify_folder

SERVE = [
    "serve",
    "--fleet",
    "sim:Navigation",
    "--robots",
    "2",
    "--humans",
    "1",
    "--policy",
    "none",
    "--learner",
    "none",
    "--port",
    "0",
]
MAIN = "from tutelage.cli import main; main()"


def tutelage(*arguments: object, input: str = "") -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", MAIN, *map(str, arguments)]
    return subprocess.run(command, input=input, capture_output=True, text=True, check=False, timeout=120)


class Served:
    """A server in a process of its own."""

    def __init__(self, out: Path, *options: object) -> None:
        command = [sys.executable, "-c", MAIN, *SERVE, "--out", str(out), *map(str, options)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.process.stdout
        self.lines: list[str] = []
        while not self.lines or self.lines[-1] != "Ctrl-C ends it":
            line = self.process.stdout.readline()
            assert line, self.process.stderr and self.process.stderr.read()
            self.lines.append(line.strip())
        found = re.search(r"console: ((https?)://([^/\s]+))(/\S*)?", "\n".join(self.lines))
        assert found
        self.address, self.path = found[1], found[4] or ""

    def stop(self, number: int = signal.SIGTERM) -> tuple[int, str, str]:
        """Exit status and the rest of what it said."""
        self.process.send_signal(number)
        out, err = self.process.communicate(timeout=30)
        return self.process.returncode, out, err

    def post(self, path: str, content: object, **options: object) -> httpx.Response:
        headers = {"origin": self.address, "x-tutelage": "1"}
        return httpx.post(self.address + path, json=content, headers=headers, **options)  # type: ignore[arg-type]


@pytest.fixture
def serving(tmp_path: Path) -> Iterator[list[Served]]:
    """Servers that a test started; none of them outlives it."""
    made: list[Served] = []
    yield made
    for server in made:
        if server.process.poll() is None:
            server.process.kill()
            server.process.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_first_start_from_the_link_to_the_end(tmp_path: Path, serving: list[Served], number: int) -> None:
    serving.append(server := Served(tmp_path))
    token = server.path.removeprefix("/#/setup/")
    assert len(token) == 43
    assert httpx.get(server.address + "/healthz").json() == {"ok": True}
    first = {"token": token, "name": "Ana", "password": PASSWORD}
    answer = server.post("/api/setup", first)
    assert answer.json() == {"name": "ana", "role": "admin"}
    assert "tutelage_session" in answer.cookies
    assert server.post("/api/setup", first).status_code == 401
    assert server.post("/api/login", {"name": "ana", "password": PASSWORD}).status_code == 200
    began = time.monotonic()
    status, out, err = server.stop(number)
    assert time.monotonic() - began < 10
    assert (status, err) == (0, "")
    assert "robots hold" in out
    said = tutelage("audit", "verify", tmp_path)
    assert said.returncode == 0
    assert "rows fit; newest hash: " in said.stdout


def test_a_server_that_is_killed_goes_on_with_what_it_had(tmp_path: Path, serving: list[Served]) -> None:
    assert tutelage("accounts", "add", "ana", "--role", "admin", "--out", tmp_path, input=PASSWORD + "\n").returncode == 0
    serving.append(server := Served(tmp_path))
    assert server.path == ""
    answer = server.post("/api/login", {"name": "ana", "password": PASSWORD})
    cookies = {"tutelage_session": answer.cookies["tutelage_session"]}
    server.post("/api/estop", {"robot": 1}, cookies=cookies)
    server.process.kill()
    server.process.communicate()
    assert verify_folder(tmp_path).ok
    serving.append(again := Served(tmp_path))
    assert httpx.get(again.address + "/api/me", cookies=cookies).json()["name"] == "ana"
    rows = httpx.get(again.address + "/api/audit", params={"kind": "login"}, cookies=cookies).json()["rows"]
    assert [row["who"] for row in rows] == ["ana"]
    assert again.stop()[0] == 0


def test_one_folder_has_one_server(tmp_path: Path, serving: list[Served]) -> None:
    serving.append(Served(tmp_path))
    said = tutelage(*SERVE, "--out", tmp_path)
    assert said.returncode == 2
    assert said.stderr == f"tutelage: another server uses {tmp_path}; give another --out\n"


@pytest.mark.parametrize(
    ("options", "why"),
    [(["--host", "0.0.0.0"], "0.0.0.0 is not this machine's own address: give --certificate and --key, or use 127.0.0.1"),
     (["--host", "192.0.2.1"], "192.0.2.1 is not this machine's own address"),
     (["--certificate", "c.pem"], "--certificate and --key are given together"),
     (["--certificate", "c.pem", "--key", "k.pem"], "c.pem and k.pem cannot be used: "),
     (["--origin", "robots.example"], "--origin is a scheme and a name"),
     (["--origin", "https://robots.example"], "make an account first: tutelage accounts add NAME --role admin --out "),
     (["--host", "no.such.name.invalid"], "no.such.name.invalid is not this machine's own address"),
     (["--port", "99999"], "--port is from 0 to 65535, not 99999"),
     (["--port", "-1"], "--port is from 0 to 65535, not -1"),
     (["--fleet", "Navigation"], "unknown fleet 'Navigation' (did you mean sim:Navigation?)"),
     (["--fleet", "sim:NoSuchTask"], "NoSuchTask")],
)  # fmt: skip
def test_what_cannot_be_served_is_one_clear_line(tmp_path: Path, options: list[str], why: str) -> None:
    said = tutelage(*SERVE, "--out", tmp_path / "out", *options)
    assert said.returncode == 2
    assert said.stderr.count("\n") == 1
    assert why in said.stderr


def test_a_run_that_was_not_served_is_left_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    said = tutelage(*SERVE, "--out", tmp_path)
    assert said.stderr == (
        f"tutelage: {tmp_path} holds a run that was not served; choose another --out, or give it as --policy\n"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]


def test_a_port_that_is_taken_is_told_before_anything_is_prepared(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        said = tutelage(*SERVE, "--out", tmp_path, "--port", port)
    assert said.returncode == 2
    assert said.stderr == f"tutelage: cannot listen on 127.0.0.1 port {port}: Address already in use\n"
    assert said.stdout == ""


def test_behind_a_proxy_nobody_counts_as_local(tmp_path: Path, serving: list[Served]) -> None:
    tutelage("accounts", "add", "ana", "--role", "admin", "--out", tmp_path, input=PASSWORD)
    serving.append(server := Served(tmp_path, "--origin", "https://robots.example", "--port", free := free_port()))
    assert server.address == "https://robots.example"
    server.address = f"http://127.0.0.1:{free}"
    headers = {"host": "robots.example", "origin": "https://robots.example", "x-tutelage": "1"}
    answer = httpx.post(f"{server.address}/api/login", json={"name": "ana", "password": PASSWORD}, headers=headers)
    assert answer.status_code == 200
    assert "; secure" in answer.headers["set-cookie"].lower()
    assert httpx.get(f"{server.address}/metrics", headers=headers).status_code == 401
    cookies = {"tutelage_session": answer.cookies["tutelage_session"]}
    assert httpx.get(f"{server.address}/metrics", headers=headers, cookies=cookies).status_code == 200
    setup = {"token": "x" * 43, "name": "eve", "password": PASSWORD}
    assert httpx.post(f"{server.address}/api/setup", json=setup, headers=headers).status_code == 403
    assert httpx.get(f"{server.address}/healthz", headers={"host": "evil.example"}).status_code == 421


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])


@pytest.mark.skipif(not socket.has_ipv6, reason="no IPv6 here")
def test_the_loopback_address_of_ipv6_will_do(tmp_path: Path, serving: list[Served]) -> None:
    serving.append(server := Served(tmp_path, "--host", "::1"))
    assert server.address.startswith("http://[::1]:")
    assert httpx.get(server.address + "/healthz").status_code == 200
    assert server.post("/api/login", {"name": "ana", "password": PASSWORD}).status_code == 401


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A certificate of this machine and its key."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "test")])
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    folder = tmp_path_factory.mktemp("tls")
    pem = serialization.Encoding.PEM
    (folder / "certificate.pem").write_bytes(made.public_bytes(pem))
    (folder / "key.pem").write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()))
    return folder / "certificate.pem", folder / "key.pem"


def test_other_addresses_need_accounts_and_speak_tls(
    tmp_path: Path, serving: list[Served], certificate: tuple[Path, Path]
) -> None:
    files = ["--certificate", certificate[0], "--key", certificate[1]]
    said = tutelage(*SERVE, "--out", tmp_path, "--host", "0.0.0.0", *files)
    assert said.returncode == 2
    assert said.stderr == f"tutelage: make an account first: tutelage accounts add NAME --role admin --out {tmp_path}\n"
    tutelage("accounts", "add", "ana", "--role", "admin", "--out", tmp_path, input=PASSWORD)
    serving.append(server := Served(tmp_path, "--host", "0.0.0.0", *files))
    server.address = server.address.replace("0.0.0.0", "127.0.0.1")
    trust = ssl.create_default_context(cafile=str(certificate[0]))
    answer = server.post("/api/login", {"name": "ana", "password": PASSWORD}, verify=trust)
    assert answer.status_code == 200
    assert "; secure" in answer.headers["set-cookie"].lower()
    assert answer.headers["strict-transport-security"]
    cookie = f"tutelage_session={answer.cookies['tutelage_session']}"
    live = server.address.replace("https", "wss") + "/api/live"
    with connect(live, origin=server.address, additional_headers={"cookie": cookie}, ssl=trust) as socket_:  # type: ignore[arg-type]
        assert json.loads(socket_.recv(10))["type"] == "hello"
    with pytest.raises(httpx.HTTPError):
        httpx.get(server.address.replace("https", "http") + "/healthz")
    assert server.stop()[0] == 0


def test_accounts_are_managed_beside_a_running_server(tmp_path: Path, serving: list[Served]) -> None:
    tutelage("accounts", "add", "root", "--role", "admin", "--out", tmp_path, input=PASSWORD)
    serving.append(server := Served(tmp_path))
    (tmp_path / "password").write_text(PASSWORD + "\nmore\n")
    add = tutelage("accounts", "add", "ben", "--out", tmp_path, "--password-file", tmp_path / "password")
    assert add.stdout == "ben may log in as operator\n"
    answer = server.post("/api/login", {"name": "ben", "password": PASSWORD})
    cookies = {"tutelage_session": answer.cookies["tutelage_session"]}
    assert tutelage("accounts", "role", "ben", "viewer", "--out", tmp_path).returncode == 0
    assert httpx.get(server.address + "/api/me", cookies=cookies).json()["role"] == "viewer"
    listed = tutelage("accounts", "list", "--out", tmp_path).stdout.splitlines()
    assert [line.split()[:2] for line in listed] == [["ben", "viewer"], ["root", "admin"]]
    assert tutelage("accounts", "password", "ben", "--out", tmp_path, input="another password\n").returncode == 0
    assert httpx.get(server.address + "/api/me", cookies=cookies).status_code == 401
    assert tutelage("accounts", "remove", "ben", "--out", tmp_path).returncode == 0
    assert server.stop()[0] == 0
    assert verify_folder(tmp_path).ok


@pytest.mark.parametrize(
    ("arguments", "why"),
    [(["add", "Ana"], "a name must be"), (["add", "ana"], "10 to 256 characters"), (["list"], "there are no accounts in"),
     (["remove", "ana"], "there are no accounts in"), (["add", "ana", "--password-file", "/no/such/file"], "cannot read"),
     (["add", "ana", "--role", "king"], "king")],
)  # fmt: skip
def test_what_is_wrong_with_accounts_is_one_clear_line(tmp_path: Path, arguments: list[str], why: str) -> None:
    said = tutelage("accounts", *arguments, "--out", tmp_path, input="short\n")
    assert said.returncode == 2
    assert said.stderr.count("\n") == 1
    assert why in said.stderr


def test_a_broken_record_is_told_with_its_row(tmp_path: Path) -> None:
    import sqlite3

    tutelage("accounts", "add", "ana", "--out", tmp_path, input=PASSWORD)
    tutelage("accounts", "add", "ben", "--out", tmp_path, input=PASSWORD)
    with contextlib.closing(sqlite3.connect(tmp_path / "record.sqlite")) as database, database:
        database.execute("UPDATE record SET who = 'eve' WHERE id = 1")
    said = tutelage("audit", "verify", tmp_path)
    assert said.returncode == 2
    assert said.stderr == f"tutelage: {tmp_path}: row 1 was altered\n"
    assert "no record" in tutelage("audit", "verify", tmp_path / "nowhere").stderr


@pytest.mark.parametrize("noted", ["xyz", "", "00" * 31, "00" * 33])
def test_half_a_noted_hash_is_no_accusation(tmp_path: Path, noted: str) -> None:
    tutelage("accounts", "add", "ana", "--out", tmp_path, input=PASSWORD)
    said = tutelage("audit", "verify", tmp_path, "--noted", noted)
    assert (said.returncode, said.stderr) == (2, "tutelage: --noted is a hash as this command prints it, 64 digits\n")


@pytest.mark.parametrize(
    "verb", [["serve"], ["accounts", "add"], ["accounts", "password"], ["audit", "verify"], ["study", "run"]]
)
def test_help_says_what_happens_without_an_option_that_is_optional(verb: list[str]) -> None:
    options = re.split(r" --(?=[a-z])", re.sub(r"[\s│]+", " ", tutelage(*verb, "--help").stdout))
    optional = [option for option in options if option.rstrip(" ╰─╯").endswith("(optional)")]
    assert optional
    assert [option for option in optional if "left out:" not in option] == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_ctrl_c_ends_a_server_at_once_and_loses_nothing(tmp_path: Path, serving: list[Served], number: int) -> None:
    serving.append(server := Served(tmp_path))
    assert server.process.stdout
    assert server.process.stderr
    server.process.send_signal(number)
    server.process.send_signal(number)  # what runs a server may send it too: still the first one
    assert server.process.stdout.readline() == "stopping; Ctrl-C again ends it at once\n"
    time.sleep(0.6)
    server.process.send_signal(number)
    err = server.process.communicate(timeout=30)[1]
    assert (server.process.returncode, err) in ((0, ""), (128 + number, "tutelage: interrupted\n"))
    assert verify_folder(tmp_path).ok


def test_a_server_that_is_interrupted_while_it_prepares_ends_at_once(tmp_path: Path) -> None:
    command = [sys.executable, "-c", MAIN, "serve", "--fleet", "sim:Navigation", "--port", "0", "--out", str(tmp_path)]
    heeds = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)}  # a shell's background jobs ignore Ctrl-C
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **heeds) as process:
        assert process.stdout
        assert process.stdout.readline()  # what is being prepared
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=30)[1] == "tutelage: interrupted\n"
        assert process.returncode == 130
