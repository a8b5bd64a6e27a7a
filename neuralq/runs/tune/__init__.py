"""Tuning: configurations tried by what is known of earlier ones, raced over seeds, and confirmed on fresh ones.

    study.json       what is asked, written once     trials/0007.json  a trial: what was chosen, what its runs scored
    space.yaml       where to look, to be read       runs/0007/seed-3  an ordinary run folder
    report.html      what came of it                 preset.yaml       the configuration that is recommended

Nothing else is remembered. What is tried next depends on the files of earlier trials only, so that a study which was
killed goes on as if nothing had happened.
"""
