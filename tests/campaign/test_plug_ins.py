"""What plug-ins do: raise anything anywhere, leave the process, return nonsense."""

import re
import time
import warnings

import pytest

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(2400)]

SOURCE = '''
import gymnasium
import numpy as np
import torch
from tensordict import TensorDict

from popl_rl.algorithms.multi_cpl import MultiCPL


class Odd(BaseException):
    """Of no kind that anybody catches."""


def end(place):
    if place == "{place}":
        {fault}
    return None


class Env(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def seen(self):
        return np.array([self.cell / 4, 1.0], np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 2
        answer = self.seen(), {{"cell": 2.0}}
        return end("reset") or answer

    def step(self, action):
        self.cell = min(max(self.cell + 2 * int(action) - 1, 0), 4)
        answer = self.seen(), 0.0, False, False, {{"cell": float(self.cell)}}
        return end("step") or answer


class Offering(Env):
    def transition_table(self):
        return end("transition_table")

    def behaviours(self):
        def act(step, generator):
            actions = torch.randint(2, step.batch_size, generator=generator)
            found = end("behaviour")
            return actions if found is None else found

        found = end("behaviours")
        return {{"own": act}} if found is None else found


class Collecting(Env):
    def collect_segments(self, num_segments, length, *, generator, progress=None):
        shape = (num_segments, length)
        steps = {{
            "observation": torch.rand(*shape, 2, generator=generator),
            "action": torch.randint(2, shape, generator=generator),
            "info": {{"cell": torch.rand(shape, generator=generator)}},
        }}
        found = end("collect")
        return TensorDict(steps, shape) if found is None else found


def make(**options):
    end("make")
    return Env()


def left(segments):
    return -segments["info", "cell"].float()


def right(segments):
    found = end("rater")
    return segments["info", "cell"].float() if found is None else found


def choose(values, count, *, generator):
    found = end("selection")
    return torch.zeros(count, dtype=torch.long) if found is None else found


class Method(MultiCPL):
    def __init__(self, problem, *, generator):
        end("init")
        super().__init__(problem, generator=generator)

    def step(self):
        said = super().step()
        found = end("generation")
        return said if found is None else found

    def result(self):
        found = end("result")
        return super().result() if found is None else found

    def state_dict(self):
        found = end("state_dict")
        return super().state_dict() if found is None else found


def read(path):
    generator = torch.Generator().manual_seed(0)
    steps = {{
        "observation": torch.rand(60, 5, 2, generator=generator),
        "action": torch.randint(2, (60, 5), generator=generator),
        "info": {{"cell": torch.rand(60, 5, generator=generator)}},
    }}
    pair = torch.stack([torch.randperm(60, generator=generator)[:2] for _ in range(40)])
    answers = {{
        "pair": pair,
        "answer": torch.randint(2, (40,), generator=generator),
        "rater": torch.arange(40) % 5,
    }}
    found = end("read")
    return (TensorDict(steps, [60, 5]), TensorDict(answers, [40])) if found is None else found


if "{place}" == "import":
    {fault}
'''
RAISED = [
    "ValueError('odd')", "KeyError('odd')", "RuntimeError('odd')", "SystemExit(0)", "SystemExit()",
    "OSError(5, 'odd')", "AttributeError('odd')", "ImportError('odd')", "AssertionError()",
    "StopIteration()", "RecursionError('odd')", "Odd()", "TypeError('odd')", "MemoryError()",
    "ZeroDivisionError('odd')", "NotImplementedError()",
]  # fmt: skip
RETURNED = {
    "reset": [
        "self_seen", "(self_seen, {}, 1)", "(None, {})", "(self_seen, None)", "('text', {})",
        "(np.zeros(3, np.float32), {})", "(np.full(2, np.nan), {})", "(np.full(2, np.inf), {})",
        "({'a': 1}, {})", "(self_seen, {'cell': float('nan')})", "(self_seen, [1])",
    ],
    "step": [
        "(self_seen, 0.0, False, {})", "(self_seen,)",
        "(np.full(2, np.nan), 0.0, False, False, {})",
        "(np.zeros(3), 0.0, False, False, {})", "(None, 0.0, False, False, {})",
        "(self_seen, float('nan'), False, False, {})", "(self_seen, None, False, False, {})",
        "(self_seen, 'much', False, False, {})", "(self_seen, 0.0, 'no', False, {})",
        "(self_seen, 0.0, False, None, {})", "(self_seen, 0.0, False, False, None)",
        "(self_seen, 0.0, False, False, {'cell': float('inf')})",
        "(self_seen, [0.0, 1.0], False, False, {})", "'ended'",
    ],
    "transition_table": ["'a table'", "torch.zeros(2, 2)", "[[0, 1], [1, 0]]"],
    "behaviours": [
        "{}", "[1]", "'explorer'", "{'own': 3}", "{'own': torch.ones(5, 2)}",
        "{'own': torch.full((5, 2), float('nan'))}", "{'own': torch.ones(5)}",
    ],
    "behaviour": [
        "torch.zeros(1).long()", "torch.zeros(64)", "'left'", "torch.full((64,), 7)", "[0] * 64",
        "torch.full((64,), -1)",
    ],
    "collect": [
        "'segments'", "TensorDict({}, [60, 5])", "TensorDict({'observation': torch.zeros(3, 5, 2), "
        "'action': torch.zeros(3, 5)}, [3, 5])",
        "TensorDict({'observation': torch.full((60, 5, 2), "
        "float('nan')), 'action': torch.zeros(60, 5)}, [60, 5])", "[1, 2]",
        "TensorDict({'observation': torch.zeros(60, 5, 2), 'action': torch.zeros(60, 5)}, [60])",
    ],
    "make": [],
    "rater": [
        "0.5", "[0.5]", "np.zeros(5)", "torch.zeros(1)", "torch.zeros(5, 1)", "'much'",
        "torch.full((1, 5), float('nan'))", "torch.full((1, 5), float('inf'))", "(1, 2)",
        "torch.zeros(1, 5, 2)", "torch.zeros(1, 5, dtype=torch.long)", "torch.rand(1, 20)",
    ],
    "selection": [
        "0", "[0, 0, 0]", "torch.zeros(3)", "torch.zeros(2).long()", "torch.full((3,), 9)",
        "torch.full((3,), -1)", "torch.zeros(3, 1).long()", "np.zeros(3, int)",
    ],
    "init": [],
    "generation": [
        "{}", "'done'", "[1.0]",
        "{'worst_rater_accuracy': 'good'}", "{'worst_rater_accuracy': 7.0}",
        "{'worst_rater_accuracy': float('nan')}", "{1: 2.0}", "0.5",
    ],
    "result": ["'a set'", "[1]", "self_population", "0"],
    "state_dict": ["'state'", "[1]", "0"],
    "read": [
        "'data'", "(1, 2)", "(TensorDict({}, [60, 5]), TensorDict({}, [40]))", "[1, 2]",
        "(TensorDict({}, [60]),)", "(None, None)", "(1, 2, 3, 4)",
    ],
    "import": [],
}  # fmt: skip
ENVIRONMENTS = {
    "reset": "Env", "step": "Env", "transition_table": "Offering", "behaviours": "Offering",
    "behaviour": "Offering", "collect": "Collecting", "make": "make",
}  # fmt: skip


def cases():
    """Place and fault of each."""
    for place, values in RETURNED.items():
        yield from ((place, f"raise {error}") for error in RAISED)
        yield from ((place, f"return {value}") for value in values)


def written(place, fault):
    """The file of a case."""
    fault = fault.replace("self_seen", "np.zeros(2, np.float32)").replace("self_population", "{}")
    if place == "import" and fault == "raise StopIteration()":
        fault = "raise StopIteration"
    return SOURCE.format(place=place, fault=fault)


def settings(place, tiny):
    """Settings of a run that comes by the place."""
    own = [
        *tiny[1:],
        "env=custom",
        f"env.factory=faulty.py:{ENVIRONMENTS.get(place, 'Env')}",
        "raters.groups=[faulty.py:left,faulty.py:right]",
        "raters.label=return",
    ]
    if place == "selection":
        own += ["method.popl.selection=faulty.py:choose"]
    if place in ("init", "generation", "result", "state_dict"):
        own = [one for one in own if not one.startswith(("method.popl", "method.refinement"))]
        own += ["method.factory=faulty.py:Method", "method.name=own", "checkpoint_interval=1"]
    if place == "read":
        own += ["data.load=faulty.py", "data.reader=faulty.py:read", "evaluation.baselines=false"]
    return own


def test_faulty_plug_ins_are_named_with_file_and_line(part, train, tiny_settings, tmp_path):
    every = list(cases())
    assert len(every) >= 150
    ends, faults, seen = time.monotonic() + 1500, [], 0
    for number, (place, fault) in enumerate(part(every)):
        if time.monotonic() > ends:
            break
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "faulty.py").write_text(written(place, fault))
        own = settings(place, tiny_settings)
        given = [one.replace("faulty.py", f"{number}/faulty.py") for one in own]
        given.append(f"run_dir={number}/run")
        seen += 1
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                outcome = train(*given, tiny=())
        except BaseException as error:
            faults.append((place, fault, repr(error)))
            continue
        told = re.search(r"faulty\.py.*", outcome.text)
        lines = re.search(r"line \d+", outcome.text)
        if outcome.code != 2 or "Traceback" in outcome.text or told is None or lines is None:
            faults.append((place, fault, outcome.code, outcome.text[-600:]))
        elif outcome.seconds > 60:
            faults.append((place, fault, outcome.seconds))
    assert faults == [], f"{len(faults)} of {seen}"


def test_what_these_plug_ins_are_made_of_works(train, tiny_settings, tmp_path):
    (tmp_path / "faulty.py").write_text(written("nowhere", "pass"))
    for place in ("step", "behaviours", "collect", "selection", "result", "read"):
        own = [
            one.replace("run_dir=run", f"run_dir={place}") for one in settings(place, tiny_settings)
        ]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            outcome = train(*own, tiny=())
        assert outcome.code == 0, (place, outcome.text)
