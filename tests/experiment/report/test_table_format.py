from __future__ import annotations

import csv
import io
import re

from lavt.experiment.report.table_format import (
    NOTHING,
    UNBROKEN,
    TableData,
    csv_of,
    format_probability,
    html_of,
    latency_column,
    number_column,
    probability_column,
    share_column,
    share_interval_column,
    tex_of,
    text_column,
)

SPECIAL_TEXT = 'a_b & 50 % of $x^2 #1 {~} \\ "<b>"\nτ'

TABLE = TableData(
    [
        text_column("name"),
        number_column("error m", 2),
        share_column("completed"),
        share_interval_column("interval"),
        latency_column("loop ms"),
    ],
    [
        [SPECIAL_TEXT, 1 / 3, 0.5, (0.123456789, 1.0), {"p5": 1.0, "p50": 2.25, "p95": 3.0, "n": 4}],
        ["nothing", None, None, None, None],
    ],
)


def test_csv_keeps_all_values_exactly() -> None:
    """The CSV has each text and number unchanged in a separate column; an unknown value is empty."""
    head, first, second = csv.reader(io.StringIO(csv_of(TABLE)))
    parts = ["loop ms p50", "loop ms p5", "loop ms p95"]
    assert head == [
        "name",
        "error m",
        "completed (share)",
        "interval low (share)",
        "interval high (share)",
        *parts,
    ]
    assert first[0] == SPECIAL_TEXT
    assert [float(cell) for cell in first[1:]] == [1 / 3, 0.5, 0.123456789, 1.0, 2.25, 1.0, 3.0]
    assert second == ["nothing", "", "", "", "", "", "", ""]


def test_latex_escapes_special_characters() -> None:
    """LaTeX's special characters are escaped, each row is one line, and a per cent sign is text."""
    lines = tex_of(TABLE).splitlines()
    row = next(line for line in lines if "a\\_b" in line)
    assert row.startswith(
        r"a\_b \& 50 \% of \$x\textasciicircum{}2 \#1 \{\textasciitilde{}\} \textbackslash{} "
        r'"$<$b$>$" $\tau$ & 0.33 & 50~\% & 12~to~100~\%'
    )
    assert lines[0] == r"% needs \usepackage{booktabs}"
    assert lines[2] == r"\resizebox{\textwidth}{!}{\begin{tabular}{lrrrr}"
    assert lines[-3:] == [r"nothing & -- & -- & -- & -- \\", r"\bottomrule", r"\end{tabular}}"]
    assert [line for line in lines if line.startswith("\\") and "rule" in line] == [
        r"\toprule",
        r"\midrule",
        r"\bottomrule",
    ]


def test_latex_reads_no_cell_as_an_option() -> None:
    """A bracket or star at the beginning of a row is escaped, so that it is no option of the preceding line break."""
    lines = tex_of(TableData([text_column("name")], [["[1 m]"], ["*"]])).splitlines()
    assert lines[5:7] == [r"{[}1 m] \\", r"{*} \\"]


def test_a_wide_latex_table_is_scaled_to_the_line() -> None:
    """A long column title is broken into lines, and a table that remains too wide is scaled."""
    column = number_column("collisions of the paper / run", 2)
    narrow, wide = (tex_of(TableData([column] * count, [[1.0] * count])).splitlines() for count in (2, 12))
    title = r"\shortstack[r]{collisions of\\the paper /\\run}"
    assert narrow[3] == rf"{title} & {title} \\"
    assert not any("graphicx" in line or "resizebox" in line for line in narrow)
    assert wide[1:3] == [
        r"% needs \usepackage{graphicx}",
        rf"\resizebox{{\textwidth}}{{!}}{{\begin{{tabular}}{{{'r' * 12}}}",
    ]
    assert wide[-1] == r"\end{tabular}}"


def test_latex_breaks_long_texts() -> None:
    """A column with a long text has line breaks, even inside JSON."""
    text = 'said: {"of_one":"word","of_two":"words, or more"}'
    for column in (text_column("endings"), text_column("endings", is_long=True)):
        lines = tex_of(TableData([column], [[text]])).splitlines()
        assert lines[1] == r"\begin{tabular}{p{6cm}}"
        assert lines[5] == (
            r'said: \{"of\_one":\allowbreak{}"word",\allowbreak{}"of\_two":\allowbreak{}"words, or more"\} \\'
        )


def test_html_escapes_texts() -> None:
    """Texts of a table are escaped in HTML, and each row has a cell for each column."""
    html = html_of(TABLE)
    assert "&lt;b&gt;" in html
    assert "<b>" not in html
    assert [len(re.findall("<t[dh]", row)) for row in html.split("<tr>")[1:]] == [5, 5, 5]


def test_columns_without_values_are_left_out() -> None:
    """A column without a known value is left out; a column with one value remains."""
    columns = [text_column("name"), number_column("known"), share_interval_column("unknown"), probability_column("p")]
    table = TableData(columns, [["a", None, None, None], ["b", 1.0, None, None]]).without_empty()
    assert [column.title for column in table.columns] == ["name", "known"]
    assert table.rows == [["a", None], ["b", 1.0]]


def test_a_small_p_value_is_not_zero() -> None:
    """A p value has two significant digits, and a very small one is shown as less than 0.0001."""
    assert [format_probability(p) for p in (None, 1.0, 0.0371, 0.00002)] == [
        NOTHING,
        "1",
        "0.037",
        f"<{UNBROKEN}0.0001",
    ]
