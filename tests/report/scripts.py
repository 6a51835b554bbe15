"""The scripts of a page, and which of them are not ours."""

from __future__ import annotations

import base64
import hashlib
import re
from importlib import resources


def foreign_scripts(page: str) -> list[str]:
    """What stands in script elements of a page and is neither data nor, letter by letter, a program
    of greybox that the page's policy names by its hash."""
    files = (p for p in resources.files("greybox.report").iterdir() if p.name.endswith(".js"))
    ours = {p.read_text(encoding="utf-8").strip() for p in files}
    found = []
    for attributes, body in re.findall(r"<script\b([^>]*)>(.*?)</script", page, re.DOTALL):
        if attributes == ' type="application/json"' or re.fullmatch(
            r' type="application/json" id="[\w-]+"', attributes
        ):
            continue
        digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        text = body.removeprefix("//<![CDATA[\n").removesuffix("\n//]]>")
        if attributes or text not in ours or f"'sha256-{digest}'" not in page:
            found.append(body)
    return found
