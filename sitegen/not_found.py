"""404.html, which a server shows in place of any page, in any folder, and which one can open from disk."""

import re

FROM_ROOT = re.compile(r'\b(href|src)="/(?!/)')
SERVED = 'location.protocol!="file:"'
BASE = f"<script>if({SERVED})document.write('<base href=\"/\">')</script>"
"""A server's pages are below its root, wherever the missing one was looked for."""
WORDS = (
    '<p>There is no such page. <a href="index.html">The front page</a> leads on; the search above finds the rest.</p>'
)
SETTINGS = '<script>if({})__config.textContent=__config.textContent.replace(\'"base": "."\',\'"base": "/"\')</script>'


def relative(html: str) -> str:
    """Return the page with addresses beside itself, on a server from its root."""
    html = html.replace("</h1>", f"</h1>\n{WORDS}", 1)
    html = FROM_ROOT.sub(r'\1="', html).replace("<head>", f"<head>{BASE}", 1)
    html = html.replace('new URL("/",location)', "new URL(document.baseURI)")
    html = html.replace('"base": "/"', '"base": "."').replace('"search": "/', '"search": "')
    start = html.index('id="__config"')
    end = html.index("</script>", start) + len("</script>")
    return html[:end] + SETTINGS.format(SERVED) + html[end:]
