"""Templates of documents, in `coopenv/report/text` and in folders of other packages."""

from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined


def templates(package: str = "coopenv.report", folder: str = "text", **options: Any) -> Environment:
    """Return the environment of the templates in a package's folder, which may import those of `coopenv/report/text`.

    `options` are Jinja's.
    """
    shared, own = PackageLoader("coopenv.report", "text"), PackageLoader(package, folder)
    return Environment(loader=ChoiceLoader([own, shared]), undefined=StrictUndefined, **options)


def rendered(template: str, package: str = "coopenv.report", folder: str = "text", **values: Any) -> str:
    """Return the text of a template, in which a line of a block alone leaves none."""
    found = templates(package, folder, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    return found.get_template(template).render(values)
