"""`mi-splat report`: one page of results, which needs no server and no network."""

from __future__ import annotations

from attacks.cli.report_options import ReportOptions
from attacks.report.charts import need_packages
from attacks.report.page import ENDINGS, write_page
from attacks.report.results import read_section
from attacks.report.wording import FIXED, plural
from mi_splat.cli.console import progress, show, show_json, warn
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.folders import check_new_file


def run(options: ReportOptions) -> int:
    """Read the results and write the page."""
    if not options.results:
        raise InvalidValueError(message("results", "one folder or more", "none", "name what a command has written"))
    check_new_file(options.out, ENDINGS, force=options.force)
    need_packages()
    with progress("reading", total=len(options.results)) as advance:
        sections = []
        for folder in options.results:
            advance(str(folder))
            sections.append(read_section(folder))
    with progress("writing the page"):
        write_page(sections, options.out, title=options.title, force=options.force)
    if options.json:
        results = [
            {"folder": one.folder, "kind": one.kind, "title": one.title, "warnings": list(one.warnings)}
            for one in sections
        ]
        show_json({"out": str(options.out), "results": results})
    else:
        for one in sections:
            show(f"{one.folder}: {one.headline.label}: {one.headline.value.replace(FIXED, ' ')}")
            if one.warnings:
                warn(f"{one.folder}: {plural(len(one.warnings), 'warning')} on the page")
        show(f"{options.out}: open it in any browser; it asks nothing of any network.")
    return 0
