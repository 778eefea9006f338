#!/opt/comvla/bin/python
"""Asks the server in this container whether it answers robots: exit code 0 or 1."""

import os
import ssl
import sys
import urllib.error
import urllib.request

port = os.environ.get("COMVLA_ADMIN_PORT", "8080")
# It asks itself over loopback: the certificate names the outside.
anyone = ssl.create_default_context()
anyone.check_hostname = False
anyone.verify_mode = ssl.CERT_NONE

for scheme in ("http", "https"):
    try:
        with urllib.request.urlopen(
            f"{scheme}://127.0.0.1:{port}/readyz", timeout=3, context=anyone
        ) as answer:
            sys.exit(answer.status != 200)
    except urllib.error.HTTPError as error:
        sys.exit(f"not ready: {error.code}")
    except (OSError, ValueError):
        continue
sys.exit(f"nobody answers on port {port}")
