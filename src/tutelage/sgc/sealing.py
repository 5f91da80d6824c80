"""Messages end to end: sealed by the sender, opened by the receiver, and nobody between can read, forge or repeat them.

Knows no network. `Sealer` makes packets, `Opener` reads them; `tutelage.sgc.packet` says what they look like.

- Secrecy: AES-256-GCM under HKDF(epoch's key, salt of the sender's start; topic, lane, epoch, sender), counters as nonces.
  The salt is what stops a nonce from repeating after a restart.
- Authenticity: the epoch's key is shared by a topic's members, so each packet also carries a proof of its sender: a
  signature, tags of pairwise sessions, or (for many messages at once, later) a signed chain. With a single session the key
  of the ciphertext is the pair's own, and proof enough.
- Freshness: a sliding window for each start of each sender, a maximum age, epochs that end.

It differs from section 8.4, which encrypts with one key, hashes, and signs each message by RSASSA-PSS: Ed25519 is 20 times
faster to make, the hash is under the signature, and what was sent once cannot be sent again.
"""

from tutelage.sgc.opener import Opener
from tutelage.sgc.packet import MAX_PAYLOAD, Opened, Packet, ident
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.sealer import Sealer

__all__ = ["MAX_PAYLOAD", "Opened", "Opener", "Packet", "Reason", "Refused", "Sealer", "ident"]
