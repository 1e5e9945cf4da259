"""The ledger: work that is done once, and found again by all that its result depends
on.

A *job* is a kind, a configuration and inputs::

    scene = {"scene": Path("car.xml")}
    render = Job(kind="attacks.rendered", config=RenderConfig(), inputs=scene)
    images = {"images": render.part("images/*")}
    judged = Job(kind="attacks.judged", config=JudgeConfig(), inputs=images)
    engine = Cluster(Path("out/store"), workers=2, on_event=print)
    done = Driver(engine).run([grid({"judged": judged})])["judged"]
    done.rows, done.folder, done.record["seconds"]

A *kind* is a module with `run(config, inputs, out)`, which builds all that it needs
itself::

    def run(config: JudgeConfig, inputs: Mapping[str, Path], out: Out) -> Rows:
        files = sorted((inputs["images"] / "images").iterdir())
        for number, file in enumerate(files):
            out.progress("judging", number, config.most)
            ...
        (out / "scores.json").write_text(...)
        return rows

- Its key is of the kind, every field of the configuration, the *content* of each input,
  and the code: the digest of the module's imports and of theirs
  (`mi_splat.import_closure`). Who makes equal images finds the splat of the first.
- `inputs` gives a path for each name: a job's folder of files, the file of a
  `part("splat.ply")`, or what was passed.
- What is written into `out.files` appears whole, when `run` has ended. `out.partial` is
  a folder that outlasts a kill or an error: a training keeps its checkpoints there and
  goes on from them. It is deleted when the job is done.
- Rows that are returned stand in job.json. Files whose bytes differ from run to run are
  named in the module's `VARIES`, and count neither as content nor in comparisons.
- What a kind loads by name, such as a detector, stands in its module as a whole dotted
  name: `LOADS = ("a.b",)`.
- A kind imports `Out` for type checkers alone, so that the ledger's own code is not in
  its key.

Jobs run in this process, or on the workers of a Dask cluster. A worker writes into the
store itself, so that only the description of a job is sent, and how its try has ended.
A file below `locks` says who does a job: one that its process has left behind when it
was killed counts as a try of the job, whichever scheduler it came from.

Results are looked at when they are used: a file that was changed since is an error, not
a result.
"""

from mi_splat.ledger.job import Done, Event, HeldError, Job, OnEvent, Out, Part
from mi_splat.ledger.store import Store

__all__ = ["Done", "Event", "HeldError", "Job", "OnEvent", "Out", "Part", "Store"]
