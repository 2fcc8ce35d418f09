# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Serve SSH on this machine until killed: ``python ssh_server.py HOME NAME...``.

Into HOME/.ssh go keys and a config by which each NAME is this server. It prints a line once it listens; whoever has the
key may run commands.
"""

from __future__ import annotations

import asyncio
import subprocess
import sys
from pathlib import Path
from typing import Any

import asyncssh


async def run(process: Any) -> None:
    """Run what a client asks for."""
    pipes: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    child = subprocess.Popen(["sh", "-c", process.command], **pipes)
    await process.redirect(stdin=child.stdin, stdout=child.stdout, stderr=child.stderr)
    process.exit(await asyncio.to_thread(child.wait))


async def serve(home: Path, names: list[str]) -> None:
    """Serve for ever."""
    folder = home / ".ssh"
    folder.mkdir(mode=0o700)
    keys = {name: asyncssh.generate_private_key("ssh-ed25519") for name in ("host", "client")}
    for name, key in keys.items():
        key.write_private_key(folder / name)
    keys["client"].write_public_key(folder / "authorized")
    options = {"server_host_keys": [folder / "host"], "authorized_client_keys": str(folder / "authorized")}
    async with asyncssh.listen("127.0.0.1", 0, process_factory=run, **options) as server:
        port = server.get_port()
        (folder / "known").write_text(f"[127.0.0.1]:{port} {keys['host'].export_public_key().decode()}")
        lines = [f"Host {' '.join(names)}", "HostName 127.0.0.1", f"Port {port}", "User ba"]
        lines += [f"IdentityFile {folder / 'client'}", f"UserKnownHostsFile {folder / 'known'}"]
        (folder / "config").write_text("\n".join([*lines, ""]))
        print("listening", flush=True)
        await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve(Path(sys.argv[1]), sys.argv[2:]))
