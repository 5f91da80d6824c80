"""The web application, running."""

from __future__ import annotations

import time

from serving import PASSWORD, Running


def test_a_person_logs_in_sees_the_fleet_and_logs_out(running: Running) -> None:
    with running.client() as client:
        assert client.get("/api/me").status_code == 401
        answer = client.post("/api/login", json={"name": "ana", "password": PASSWORD})
        assert answer.json() == {"name": "ana", "role": "operator"}
        assert client.get("/api/me").json() == {"name": "ana", "role": "operator", "seat": None}
        fleet = client.get("/api/fleet").json()
        assert fleet["task"] == "Points"
        assert len(fleet["robots"]) == 4
        assert abs(fleet["server_time"] - time.time()) < 5
        client.post("/api/logout")
        assert client.get("/api/me").status_code == 401
    running.audit.flush()
    kinds = [(row.kind, row.who) for row in running.audit.rows()]
    assert ("logout", "ana") in kinds
    assert ("login", "ana") in kinds


def test_live(running: Running) -> None:
    with running.socket("ana") as ana:
        assert ana.hear("hello")["me"] == {"name": "ana", "role": "operator", "seat": 0}
        ana.hear("state")
        running.supervision.offer(2, "ana")
        ana.hear("offer", robot=2)
        ana.say("accept", robot=2, ref=7)
        lease = ana.hear("lease", robot=2)
        ana.hear("ack", ref=7)
        ana.say("command", robot=2, lease=lease["id"], seq=1, action=[0.5])
        ana.say("ping", n=3, time=12.5)
        pong = ana.hear("pong", n=3)
        assert pong["time"] == 12.5
        assert running.supervision.commands[-1] == ("ana", 2, 1, [0.5], False, None)
        ana.say("give_back", robot=2)
        ana.hear("lease_end", robot=2, why="given_back")
