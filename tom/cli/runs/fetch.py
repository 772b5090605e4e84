"""`tom runs fetch`: download runs from an object store."""

import argparse
import json

from tom.errors import UserError
from tom.harmless import terminal
from tom.record import Store


def add_verbs(verbs, add_verb) -> None:
    verb = add_verb(verbs, "fetch", fetch, "copy runs [all] from an object store into the store")
    verb.add_argument("url", metavar="s3://BUCKET/PREFIX", help="the --store of `tom sweep`")
    verb.add_argument("run_ids", metavar="RUN", nargs="*")


def fetch(args: argparse.Namespace) -> int:
    from tom.record.bucket.attempts import fetch_run, run_ids
    from tom.record.bucket.objects import Bucket

    bucket, store = Bucket.open(args.url), Store(args.store)
    done: dict[str, str] = {}
    try:
        wanted = args.run_ids or run_ids(bucket)
        if not wanted:
            raise UserError(f"no runs in {args.url}: is it the --store of a sweep?")
        store.ensure_writable()
        for run_id in wanted:
            done[run_id] = fetch_run(bucket, run_id, store)
            if not args.json:
                print(terminal(f"{run_id} {done[run_id]}"), flush=True)
    except OSError as error:
        raise UserError(f"{args.url}: {error}") from error
    if args.json:
        print(json.dumps(done))
    return 0
