"""Compiles tables with pdflatex, the program that has to read them."""

import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path

PDFLATEX = shutil.which("pdflatex")
#: booktabs, or rules of LaTeX itself where Debian's texlive-latex-base is all there is.
_PREAMBLE = r"""\documentclass{article}
\IfFileExists{booktabs.sty}{\usepackage{booktabs}}{%
  \let\toprule\hline\let\midrule\hline\let\bottomrule\hline
  \def\cmidrule(##1)##2{\cline{##2}}}
\usepackage{graphicx}
"""


def errors_of(tables: Iterable[str], folder: Path) -> str:
    """Compile tables as the body of a document; return pdflatex's log, or nothing without errors.

    Args:
        tables: LaTeX of tables. In the log, `table 3` comes before the faults of the fourth.
        folder: Where to write the document.
    """
    assert PDFLATEX is not None
    body = [rf"\typeout{{table {n}}}{text}\clearpage" for n, text in enumerate(tables)]
    page = "\n".join([_PREAMBLE, r"\begin{document}", *body, r"\end{document}"])
    (folder / "x.tex").write_text(page, encoding="utf-8")
    command = [PDFLATEX, "-interaction=nonstopmode", "-halt-on-error", "-draftmode", "x.tex"]
    done = subprocess.run(command, cwd=folder, capture_output=True, check=False)
    return "" if done.returncode == 0 else done.stdout.decode(errors="replace")[-2000:]
