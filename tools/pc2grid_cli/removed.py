"""What is said of commands and options that the program had before."""

REMOVED = {
    "pc2grid diff": "`pc2grid db join --plot OUT.png` draws the walls of joined sessions over each other",
    **dict.fromkeys(
        ("pc2grid convert --rerun", "pc2grid export --rerun"),
        "`pc2grid export --mcap OUT.mcap` writes the map, `rerun OUT.mcap` shows it",
    ),
    "pc2grid relocalize --rerun": "`--output OUT.mcap` writes the answer, `rerun OUT.mcap` shows it",
    **dict.fromkeys(
        ("pc2grid db join --journal", "pc2grid db join --dask", "pc2grid db join --jobs"),
        "one process compares every two sessions, some seconds a pair",
    ),
    "pc2grid compare floors": "a recording is one floor: cut it with `--start` and `--duration`",
    **dict.fromkeys(
        ("pc2grid simulate --floors", "pc2grid simulate --ride", "pc2grid simulate --slope"),
        "a recording is one floor: `pc2grid simulate` makes one for each `--seed`",
    ),
    **dict.fromkeys(
        ("pc2grid simulate --change", "pc2grid simulate --walkers", "pc2grid simulate --relief"),
        "another `--seed` and `--clutter` place other objects in the same building",
    ),
    **dict.fromkeys(
        ("pc2grid simulate --glass", "pc2grid simulate --mirrors"),
        "all walls of a simulated building are opaque",
    ),
    "pc2grid simulate --alike": "a recording is one floor: the same `--seed` places the same objects",
    **dict.fromkeys(
        ("pc2grid compare log", "pc2grid compare maps"),
        "`pc2grid compare recordings FOLDER`, with true poses in NAME.tum beside NAME.mcap",
    ),
    "pc2grid compare signatures": "`pc2grid compare recordings DATA --shortlist shuffled`: without them",
    "pc2grid compare real": "its rows are those of `pc2grid compare recordings DATA --only 'other sensor'`",
    "pc2grid watch --last": "a finished recording is followed whole, and ws://ROBOT:8765 while it runs",
    "pc2grid watch --keep": "`pc2grid watch` goes on to the end; `--first` stops when it is located",
    "pc2grid db update": "`pc2grid db join` puts sessions into one frame, `pc2grid export --map` draws them",
    "pc2grid convert --update": "`--join` puts what is new into the frame of the other sessions",
}
"""By command, or by command and option: what to use instead."""
