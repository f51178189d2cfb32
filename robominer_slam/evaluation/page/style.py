"""The page's style sheet: follows the reader's light or dark setting, and fits a phone."""

STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; margin: 1.5rem auto; max-width: 75rem; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: .3rem; } h2 { font-size: 1.25rem; margin-top: 2.5rem; }
h3 { font-size: 1.05rem; margin-bottom: .3rem; }
p, li { max-width: 46rem; } .note { opacity: .75; font-size: .92rem; }
nav a { margin-right: .9rem; white-space: nowrap; }
.tables { display: flex; flex-wrap: wrap; gap: 0 3rem; } .tables > div { max-width: 100%; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .7rem; text-align: right; white-space: nowrap; }
td { border-bottom: 1px solid rgba(128, 128, 128, .35); } th { vertical-align: bottom; }
th:first-child, td:first-child { text-align: left; white-space: normal; } thead th { white-space: normal; }
.runs table { font-size: .85rem; } .runs th, .runs td { padding: .15rem .45rem; }
.runs td:nth-child(-n + 3), .runs th:nth-child(-n + 3) { text-align: left; white-space: nowrap; }
thead th { border-bottom: 2px solid rgba(128, 128, 128, .8); vertical-align: bottom; }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 26rem), 1fr)); gap: 1rem; }
figure { margin: 0; } figure.wide { grid-column: 1 / -1; max-width: 56rem; }
figure.wide div { overflow-x: auto; } figure.wide img { min-width: 34rem; }
figure img { width: 100%; height: auto; background: white; border-radius: 4px; box-sizing: border-box; padding: 4px; }
figcaption { font-size: .88rem; opacity: .85; margin-top: .2rem; }
summary { cursor: pointer; font-weight: 600; margin: .6rem 0; }
"""
