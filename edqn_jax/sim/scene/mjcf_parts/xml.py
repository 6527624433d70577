"""Reads XML as MuJoCo's parser, tinyxml2, does, which is laxer than the standard, and writes it as the standard has it.

Two dashes in a comment, a lone `&`, a `<` in quotes, control characters and text beside the elements are read; MJCF has
no text, so that only elements and their attributes are kept. What is written has its elements in their lines, for
MuJoCo's messages.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from xml.sax.saxutils import quoteattr

DEEPEST = 500
"""Elements within each other that tinyxml2 reads."""

_BLANKS = " \t\n\v\f\r"
_SPACE = r"[ \t\n\v\f\r]*"
_NAME = r"[A-Za-z_:\u0080-\U0010ffff][A-Za-z0-9_:.\-\u0080-\U0010ffff]*"
_OPENED = re.compile(rf"<{_SPACE}(/?)({_NAME})")
_ATTRIBUTE = re.compile(rf"{_SPACE}({_NAME}){_SPACE}={_SPACE}(?:\"([^\"]*)\"|'([^']*)')")
_CLOSED = re.compile(rf"{_SPACE}(/?)>")
_REFERENCE = re.compile(r"&(?:#x([0-9A-Fa-f]*)|#([0-9]*)|(quot|amp|apos|lt|gt));")
_NAMED = {"quot": '"', "amp": "&", "apos": "'", "lt": "<", "gt": ">"}


class MarkupError(ValueError):
    """The text is no XML for tinyxml2; the message names the line."""


class SubsetError(MarkupError):
    """A declaration holds other declarations, which parsers end differently."""


def parse_xml(text: str) -> tuple[ElementTree.Element, str]:
    """Returns the first element of a document, and the document as XML of that element alone.

    Raises:
        MarkupError: if tinyxml2 would not read it, or a `<!DOCTYPE>` declares anything.
    """
    return _Reader(text.removeprefix("\ufeff").partition("\0")[0]).read()  # tinyxml2 reads up to a zero


class _Reader:
    """Reads a text once from its beginning to its end."""

    def __init__(self, text: str) -> None:
        self.text = text.replace("\r\n", "\n").replace("\r", "\n")
        self.root: ElementTree.Element | None = None
        self.opened: list[tuple[ElementTree.Element, int]] = []
        self.written: list[str] = []
        self.begun = False  # whether anything but declarations was read

    def read(self) -> tuple[ElementTree.Element, str]:
        """Returns the first element, and it alone as XML."""
        at = 0
        while at < len(self.text):
            begin = self.text.find("<", at)
            between = self.text[at : begin if begin >= 0 else None]
            if between.strip(_BLANKS):
                self.begun = True
                if begin < 0 and self.root is None and not self.opened:
                    raise MarkupError("it is no XML: it has no element")
                if begin < 0:
                    raise self._error(at, "text must not be the last of all")
            self.written.append("\n" * between.count("\n"))
            at = self._markup(begin) if begin >= 0 else len(self.text)
        if self.opened:
            element, begin = self.opened[-1]
            raise self._error(begin, f"<{element.tag}> is not closed")
        if self.root is None:
            raise MarkupError("it has no element")
        return self.root, "".join(self.written)

    def _markup(self, begin: int) -> int:
        """Reads the markup that begins with '<' at an index; returns the index of its end."""
        for mark, closing in (("<?", "?>"), ("<!--", "-->"), ("<![CDATA[", "]]>"), ("<!", ">")):
            if not self.text.startswith(mark, begin):
                continue
            end = self.text.find(closing, begin + len(mark))
            if end < 0:
                raise self._error(begin, f"'{mark}' is not closed by '{closing}'")
            if mark == "<?" and self.begun:
                raise self._error(begin, "a declaration must stand before everything else")
            if mark == "<!" and "[" in self.text[begin:end]:
                raise SubsetError
            self.begun |= mark != "<?"
            self.written.append("\n" * self.text.count("\n", begin, end))
            return end + len(closing)
        self.begun = True
        return self._element(begin)

    def _element(self, begin: int) -> int:
        found = _OPENED.match(self.text, begin)
        if found is None:
            raise self._error(begin, "a '<' must be followed by a name; in text, write &lt;")
        closes, name = found.groups()
        attributes: dict[str, str] = {}
        at = found.end()
        while pair := _ATTRIBUTE.match(self.text, at):
            key, double, single = pair.groups()
            if key in attributes:
                raise self._error(pair.start(1), f"<{name}> has '{key}' twice")
            attributes[key] = _decode_attribute(single if double is None else double)
            at = pair.end()
        last = _CLOSED.match(self.text, at)
        if last is None:
            raise self._error(at, f'<{closes}{name}> has something that is neither name="value" nor its end')
        if closes and not last[1]:  # </name/> is an empty element
            return self._close(name, begin, last.end())
        self._take(name, attributes, bool(last[1]), begin, last.end())
        return last.end()

    def _take(self, name: str, attributes: dict[str, str], empty: bool, begin: int, end: int) -> None:
        """Adds the element of an opening tag to the tree."""
        element = ElementTree.Element(name, attributes)
        if self.opened:
            self.opened[-1][0].append(element)
        elif self.root is None:
            self.root = element
        words = [f"<{name}", *(f"{key}={_quote(value)}" for key, value in attributes.items())]
        if not empty:
            self.opened.append((element, begin))
        if len(self.opened) > DEEPEST:
            raise self._error(begin, f"more than {DEEPEST} elements are within each other")
        self._write(element, " ".join(words) + ("/>" if empty else ">"), self.text.count("\n", begin, end))

    def _close(self, name: str, begin: int, end: int) -> int:
        """Reads a closing tag; returns where to continue, or the end if it closes nothing, which ends the document."""
        if not self.opened:
            return len(self.text)
        element, _ = self.opened[-1]
        if element.tag != name:
            raise self._error(begin, f"</{name}> closes <{element.tag}>")
        self.opened.pop()
        self._write(element, f"</{name}>", self.text.count("\n", begin, end))
        return end

    def _write(self, element: ElementTree.Element, tag: str, lines: int) -> None:
        """Writes a tag of the first element or within it, and line breaks for as many lines as it had."""
        if (self.opened[0][0] if self.opened else element) is not self.root:
            tag = ""
        self.written.append(tag + "\n" * (lines - tag.count("\n")))

    def _error(self, at: int, reason: str) -> MarkupError:
        return MarkupError(f"line {self.text.count(chr(10), 0, at) + 1}: {reason}")


def _decode_attribute(value: str) -> str:
    """Returns an attribute's value with its references replaced; those that tinyxml2 does not know stay as they are."""

    def character(found: re.Match[str]) -> str:
        sixteen, ten, name = found.groups()
        if name is not None:
            return _NAMED[name]
        digits, base = (ten, 10) if sixteen is None else (sixteen, 16)
        if len(digits) > 16:
            return found[0]
        number = int(digits or "0", base)
        if number > 0x10FFFF:
            return found[0]
        return "\ufffd" if 0xD800 <= number < 0xE000 else chr(number)

    return _REFERENCE.sub(character, value).partition("\0")[0]


def _quote(value: str) -> str:
    """Returns a value in quotes, with line breaks as they are."""
    return quoteattr(value).replace("&#10;", "\n").replace("&#9;", "\t")
