"""Comments behind the fields of dataclasses as their documentation: `position: Array  # [N, 3] centre, metres`."""

from __future__ import annotations

import ast
import io
import tokenize

from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer


def field_comments(code: str) -> dict[tuple[str, str], str]:
    """Returns the comment behind each annotated field of the module's classes, by class and name."""
    comments = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(code).readline)
        if token.type == tokenize.COMMENT
    }
    return {
        (kind.name, field.target.id): comments[field.end_lineno]
        for kind in ast.parse(code).body
        if isinstance(kind, ast.ClassDef)
        for field in kind.body
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and field.end_lineno in comments
    }


def analyze(analyzer: ModuleAnalyzer) -> None:
    """Parses a module as Sphinx does, and adds the comments."""
    if not analyzer._analyzed:
        _analyze(analyzer)
        for name, comment in field_comments(analyzer.code).items():
            analyzer.attr_docs.setdefault(name, [comment, ""])


_analyze = ModuleAnalyzer.analyze


def setup(app: Sphinx) -> dict[str, bool]:
    """Takes the place of Sphinx's own analysis."""
    ModuleAnalyzer.analyze = analyze
    return {"parallel_read_safe": True, "parallel_write_safe": True}
