"""Short addresses that restore a view: `/v/<code>` leads to the page with all its choices.

The views are in `<store>/.views`, one small file each, named by a digest of its content.
"""

import hashlib
import re
from pathlib import Path
from urllib.parse import urlencode

import streamlit as st

from app import session, text
from tom.errors import UserError
from tom.record.files import read_json, replace_json
from tom.record.store import Store

CODE = re.compile(r"[0-9a-f]{8}")
NOWHERE = (
    "This studio's store has no view {}. A short link works only with the store it was made in, as "
    "long as that store's folder .views exists. Ask for the long address."
)


def save(store: Path | str, page: str, query: str) -> str:
    """Store a page's address and return its code. The same view has the same code.

    Raises UserError if the store cannot be written.
    """
    code = hashlib.sha256(f"{page}?{query}".encode()).hexdigest()[:8]
    folder = Store(store).beside(".views")
    try:
        folder.mkdir(exist_ok=True)
        replace_json(folder / f"{code}.json", {"page": page, "query": query}, sync=False)
    except OSError as error:
        raise UserError(f"no view can be kept in {folder} ({error.strerror})") from error
    return code


def target(store: Path | str, code: str) -> str | None:
    """The address of a code on this server; None if there is no such view."""
    try:
        path = Store(store).beside(".views") / f"{code}.json"
        if not CODE.fullmatch(code) or path.is_symlink():
            return None
        held = read_json(path)
        page, query = str(held["page"]), str(held["query"])
    except (OSError, ValueError, KeyError, TypeError, UserError):
        return None
    return f"/{page}?{query}" if re.fullmatch(r"[a-z]*", page) and query.isprintable() else None


def button() -> None:
    """A small menu with the address of the shown view, and a short one if the store is writable."""
    # Drawn again when it is opened: a zoom draws its panels alone.
    with st.popover("Link", icon=":material/link:", key="link", on_change="rerun"):
        query = urlencode({key: st.query_params.get_all(key) for key in st.query_params}, True)
        here = (st.context.url or "").split("?")[0]
        page = here.rstrip("/").rpartition("/")[2]
        address = f"{here}?{query}"
        if not session.read_only_reason() and st.button("Make a short link", key="short link"):
            try:
                code = save(session.links().store, page, query)
                address = f"{here.rstrip('/').removesuffix(page)}v/{code}"
            except UserError as error:
                st.error(text.markdown(error), icon=":material/error:")
        st.caption("This address shows what you see now, filters and choices included.")
        st.code(address, language=None, wrap_lines=True)
