"""A report's page as PDF, by WeasyPrint, which is optional: it needs Pango from the system (docs/decisions/0031)."""

from __future__ import annotations

import logging

HOW_TO_INSTALL = "pip install 'rigcal[pdf]' and apt install libpango-1.0-0 libpangoft2-1.0-0 libharfbuzz-subset0"


class PdfError(Exception):
    """A PDF cannot be made on this computer."""


def pdf_of(page: str) -> bytes:
    """Return a self-contained page as PDF: A4, numbered, with its own figures; nothing is loaded from elsewhere.

    Args:
        page: the HTML document.

    Raises:
        PdfError: WeasyPrint or a library that it needs is not installed.
    """
    try:
        import weasyprint
        from weasyprint.urls import URLFetcher
    except (ImportError, OSError) as error:  # OSError: the package is there, and Pango is not
        raise PdfError(
            f"a PDF needs WeasyPrint with Pango: {HOW_TO_INSTALL}; or print the HTML page from any browser"
        ) from error

    for name in ("weasyprint", "fontTools"):
        logging.getLogger(name).setLevel(logging.ERROR)  # it tells of every CSS property that it does not know
    fetcher = URLFetcher(allowed_protocols=["data"])
    document: bytes = weasyprint.HTML(string=page, url_fetcher=fetcher).write_pdf()
    return document
