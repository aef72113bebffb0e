"""File names in answers: they contain a site's name and no patient data."""

from __future__ import annotations

import re


def plain_name(site: str) -> str:
    """Return a site's name as part of a file name.

    Characters other than letters, digits, dot, dash and underscore become underscores. The name is never empty and never
    begins with a dot.
    """
    return re.sub(r"[^A-Za-z0-9._-]", "_", site).lstrip(".") or "site"
