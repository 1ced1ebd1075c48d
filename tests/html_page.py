"""HTML pages as tests read them."""

import re
from html.parser import HTMLParser


class Page(HTMLParser):
    """A parsed page: checks nesting; collects tables by caption or header, ids, links, images, headings, all text.

    Attributes:
        mute: header cells that do not say whether they are of a row or of a column.
    """

    VOID = frozenset({"meta", "img", "br"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.captions: dict[str, list[list[list[str]]]] = {}
        self.ids: list[str] = []
        self.links: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.headings: list[tuple[int, str]] = []
        self.tags: set[str] = set()
        self.mute = 0
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.tags.add(tag)
        if tag not in self.VOID:
            self.open.append(tag)
        if values.get("id"):
            self.ids.append(str(values["id"]))
        if tag == "a":
            self.links.append(str(values["href"]))
        elif tag == "img":
            self.images.append(values)
        elif tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
            self.mute += tag == "th" and not values.get("scope")
        elif re.fullmatch(r"h\d", tag):
            self.headings.append((int(tag[1]), ""))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" in self.open:
            return
        self.text += data
        if "caption" in self.open:
            self.captions.setdefault(data, []).append(self.tables[-1])
        elif "td" in self.open or "th" in self.open:
            self.tables[-1][-1][-1] += data
        elif self.open and re.fullmatch(r"h\d", self.open[-1]):
            self.headings[-1] = (self.headings[-1][0], self.headings[-1][1] + data)

    def table(self, *head: str) -> list[list[str]]:
        """The rows of the first table that begins with these headers."""
        return next(rows[1:] for rows in self.tables if rows and rows[0][: len(head)] == list(head))
