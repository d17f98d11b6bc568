"""Signature of a submission or of a folder of results: Ed25519 over the record of all its files.

    signature.json   public key and signature, in hexadecimal digits

The owner of an entry keeps the private key (a PEM file); the public one names the owner. Needs the
extra `sign`.
"""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from road_envs.core.atomic_io import write_text
from road_envs.core.config import ConfigError
from road_envs.core.extras import optional_import
from road_envs.core.reading import parsing, regular

FILE = "signature.json"
RECORD = "submission.json"


def signer(key: Path) -> Callable[[Path], str]:
    """Return a function that signs the record in a folder with a private `key`, made if it does not
    exist, and returns the public one. Raises ConfigError for a file that is no key.
    """
    ed25519, serialization, _ = _library()
    if not key.exists():
        made = ed25519.Ed25519PrivateKey.generate()
        form = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
        text = made.private_bytes(*form, serialization.NoEncryption())
        with os.fdopen(os.open(key, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(text)
    with parsing(key, ConfigError, "not a private key in PEM format"):
        private = serialization.load_pem_private_key(regular(key).read_bytes(), None)
    if not isinstance(private, ed25519.Ed25519PrivateKey):
        raise ConfigError(f"{key}: not an Ed25519 key")
    public = private.public_key().public_bytes_raw().hex()

    def sign(folder: Path) -> str:
        signature = private.sign((folder / RECORD).read_bytes()).hex()
        text = json.dumps({"key": public, "signature": signature}, indent=1)
        write_text(folder / FILE, text + "\n")
        return public

    return sign


def verify(folder: Path) -> str | None:
    """Return the public key that has signed the record in `folder`; None if it is not signed.
    Raises ConfigError for a signature that is not valid.
    """
    path = folder / FILE
    if not path.exists():
        return None
    ed25519, _, InvalidSignature = _library()
    with parsing(path, ConfigError, "damaged, not a signature"):
        data = json.loads(regular(path).read_text(encoding="utf-8"))
        public = ed25519.Ed25519PublicKey.from_public_bytes(bytes.fromhex(data["key"]))
        signature = bytes.fromhex(data["signature"])
    try:
        public.verify(signature, (folder / RECORD).read_bytes())
    except InvalidSignature:
        raise ConfigError(f"{path}: not the signature of {RECORD}") from None
    return data["key"]


def check_owner(folder: Path, replaces: Path | None) -> None:
    """Raise ConfigError unless the key that has signed `replaces`, if any, has signed `folder`."""
    key, owner = verify(folder), None if replaces is None else verify(replaces)
    if owner is not None and key != owner:
        signed = "is not signed" if key is None else f"is signed by the key {key[:12]}"
        raise ConfigError(
            f"{folder}: {signed}, what it replaces by the key {owner[:12]}; sign it with that one"
        )


def _library() -> tuple[Any, Any, Any]:
    with optional_import("a signature"):
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519
    return ed25519, serialization, InvalidSignature
