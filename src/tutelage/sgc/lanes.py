"""The keys under which things travel: the name of a topic, and a lane. Routers know these and no more (see `router`)."""

from __future__ import annotations

from tutelage.sgc.names import Name

STREAM = "stream"  # sealed messages: publishers to subscribers
REPLAY = "replay"  # requests for missing messages: a subscriber to the publisher of one salt
HELLO = "hello"  # "I do not know you": subscribers to publishers
OFFER = "offer"  # session handshake: subscribers to publishers
ANSWER = "answer"  # session handshake: publishers to subscribers
KEYS = "keys"  # requests for the topic's key: members to the owner
GRANTS = "grants"  # keys that the owner hands out unasked
CALL = "call"  # requests to a service
HERE = "here"  # presence, with the pseudonym
ECHO = "echo"  # pings, with the pseudonym
DENY = "deny"  # on the fleet's control channel: the deny list
RULES = "rules"  # on the fleet's control channel: which of its topics a router knows a node to have a part in
RENEW = "renew"  # on the fleet's control channel: certificates to renew, changes of the policy


def key(name: Name, lane: str, of: str = "") -> str:
    """The key of a lane; `of`: the salt or pseudonym that it belongs to, "*" for anyone's.

    A name is cut in three, as a router looks through all that begin alike: 10,000 names in one row would take it 10 ms each.
    """
    digits = name.hex()
    end = f"{lane}/{of}" if of else lane
    return f"{digits[:2]}/{digits[2:4]}/{digits[4:]}/{end}"
