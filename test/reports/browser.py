"""Pages in headless Chromium: what overflows, what the console says, which pictures do not load."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
#: A frame in a page has the width that is requested; windows have a least width of 500 px.
_FRAME = """<!DOCTYPE html><html><head><meta name="color-scheme" content="light dark"></head>
<body style="margin:0">
<iframe id="page" style="border:0;width:{width}px;height:900px" srcdoc="{page}"></iframe>
<pre id="found"></pre><script>
window.addEventListener("load", () => {{
  const inner = document.getElementById("page").contentDocument, root = inner.documentElement;
  const clips = (one) => one.closest(".scroll") !== null;
  const wide = [...inner.body.querySelectorAll("*")].filter((one) =>
    !clips(one) && one.getBoundingClientRect().right > {width} + 1);
  document.getElementById("found").textContent = "FOUND" + JSON.stringify({{
    width: root.clientWidth, reach: root.scrollWidth,
    wide: wide.map((one) => one.tagName + " " + one.textContent.trim().slice(0, 40)),
    pictures: inner.images.length,
    broken: [...inner.images].filter((one) => !one.complete || one.naturalWidth === 0).length,
    unnamed: [...inner.images].filter((one) => !one.alt.trim()).length,
    ink: getComputedStyle(inner.body).color, paper: getComputedStyle(inner.body).backgroundColor,
  }}) + "END";
}});
</script></body></html>"""


@dataclass(frozen=True)
class Seen:
    """What a browser made of a page: widths in px, what reaches beyond, pictures, colours, console lines."""

    width: int
    reach: int
    wide: list[str]
    pictures: int
    broken: int
    unnamed: int
    ink: str
    paper: str
    console: list[str]


def open_page(page: str, folder: Path, *, width: int, dark: bool) -> Seen:
    """Open a page in Chromium at a width [px]; pictures beside it are looked for in the folder."""
    assert CHROMIUM is not None
    place = folder / "frame.html"
    place.write_text(_FRAME.format(width=width, page=html.escape(page)))
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    command += ["--enable-logging=stderr"]
    command += [
        f"--user-data-dir={folder / 'profile'}",
        "--window-size=1400,1000",
        "--virtual-time-budget=5000",
    ]
    command += ["--force-dark-mode"] if dark else []
    done = subprocess.run(
        [*command, "--dump-dom", place.as_uri()], capture_output=True, text=True, timeout=240, check=True
    )
    found = re.search(r"FOUND(\{.*?\})END</pre>", done.stdout, flags=re.DOTALL)
    assert found is not None, done.stderr[-2000:]
    console = re.findall(r"CONSOLE:.*", done.stderr)
    return Seen(**json.loads(html.unescape(found[1])), console=console)
