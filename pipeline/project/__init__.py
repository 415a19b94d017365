"""A trial as one file (`balise.toml`, `schemas/project.py`) and one call: `balise init`, `trial` and `run`.

In: a project file, or the logs and surveys to make one of. Out: runs, a site, a result and its report, brought up to
date: what was made of the same content with the same settings by the same program is left as it is.
Touches files; what each step does is done by the door whose command it is (`make`, `campaign`, `show`).

- Where does a project stand, what do its paths mean, which options do other commands take from it? `opened`.
- What is up to date? `made`. One run of its logs: `convert`. All steps, in order: `run`.
- Which stream does a log feed, which logs are of one run, what has to be corrected? `looking`, `recorded_runs`,
  `trial`.
- What lies in a folder? `found`. How is the file written? `draft`.
"""
