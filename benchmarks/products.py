"""Whether another library makes an update's matrix products quicker than XLA does.

    python benchmarks/products.py
    python benchmarks/products.py --updates     whole updates, in each way of pacesetter

The products are read out of the updates themselves. Each is timed alone, a few independent ones a
call, and the best of many short repeats counts; the libraries take turns. XLA may take the sides of
a product in either order, and overlap products; the others make one after the other, each on all
cores. Operands are in the precision already; a product with a side below 64 stays float32 in bf16
too, as `--precision bf16` has it.

Needs gcc, and `pip install onednn-cpu-gomp onednn-devel-cpu-gomp` for oneDNN, `apt-get install
libxsmm-dev` for libxsmm. What is absent gets a line that says so.
"""

import argparse
import ctypes
import itertools
import json
import os
import re
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from ceiling import SPECS, TOGETHER, Product, flops, products, swapped, timed, whole
from scipy.stats import gmean
from tabulate import tabulate

from pacesetter import algorithms
from pacesetter.batch import Layout as Rows
from pacesetter.config import resolve
from pacesetter.learner.precision import SMALL
from pacesetter.learner.products import LIBRARIES, VARIABLE, loaded

NAMES = ("td3", "sac", "crossq-small")
BATCHES = (64, 128, 256, 512)
DECISIVE = (128, 256)  # the batches that decide, both of them
PRECISIONS = ("f32", "bf16")
KINDS = (("f32", "xla"), ("f32", "libxsmm"), ("bf16", "xla"), ("bf16", "onednn"))  # of updates
GOALS = {("f32", 1): 1.3, ("bf16", 1): 2.0, ("f32", 2): 1.5, ("bf16", 2): 1.5}  # over XLA
WRONG = {"f32": 1e-5, "bf16": 1e-2}  # a relative error that says a product is another one
SAID = re.compile("error|cannot find")  # in the line of the compiler that matters
SPAN = 0.01  # seconds of one repeat
WAYS: dict[str, dict[str, Any]] = {  # of XLA, by its options
    "XLA": {},
    "XLA without YNNPACK": {"xla_cpu_experimental_ynn_fusion_type": ""},
    "XLA with oneDNN calls": {
        "xla_cpu_use_onednn": True,
        "xla_cpu_experimental_onednn_custom_call": True,
    },
}
PRODUCT_C = """
typedef struct { long pair, m, n, k, left_t, right_t, low; void *left, *right, *out, *made; } P;
"""
ONEDNN_C = """
#include <oneapi/dnnl/dnnl.h>
#include <stdlib.h>
typedef struct { dnnl_primitive_t call; dnnl_exec_arg_t on[3]; } Made;
static dnnl_engine_t engine;
static dnnl_stream_t stream;

static dnnl_memory_desc_t matrix(P *p, long rows, long columns, int turned, int low) {
  dnnl_dims_t size = {p->pair, rows, columns};
  dnnl_dims_t step = {rows * columns, turned ? 1 : columns, turned ? rows : 1};
  int one = p->pair == 1;
  dnnl_memory_desc_t found = 0;
  dnnl_memory_desc_create_with_strides(
      &found, 3 - one, size + one, low ? dnnl_bf16 : dnnl_f32, step + one);
  return found;
}

int prepare(P *p, long count) {
  if (!engine && dnnl_engine_create(&engine, dnnl_cpu, 0)) return 1;
  if (!stream && dnnl_stream_create(&stream, engine, dnnl_stream_default_flags)) return 1;
  for (; count--; p++) {
    Made *made = p->made = malloc(sizeof(Made));
    dnnl_memory_desc_t sides[] = {matrix(p, p->m, p->k, p->left_t, p->low),
        matrix(p, p->k, p->n, p->right_t, p->low), matrix(p, p->m, p->n, 0, 0)};
    int kinds[] = {DNNL_ARG_SRC, DNNL_ARG_WEIGHTS, DNNL_ARG_DST};
    void *places[] = {p->left, p->right, p->out};
    dnnl_primitive_desc_t plan;
    if (dnnl_matmul_primitive_desc_create(&plan, engine, sides[0], sides[1], 0, sides[2], 0))
      return 1;
    if (dnnl_primitive_create(&made->call, plan)) return 1;
    for (int i = 0; i < 3; i++) {
      made->on[i].arg = kinds[i];
      if (dnnl_memory_create(&made->on[i].memory, sides[i], engine, places[i])) return 1;
    }
  }
  return 0;
}

void run(P *p, long count) {
  for (; count--; p++) {
    Made *made = p->made;
    dnnl_primitive_execute(made->call, stream, 3, made->on);
  }
}
"""
# libxsmm counts by columns, so the two sides change places. It makes a block of columns a call,
# packed as it needs them: right sides that are transposed, and pairs of rows for bf16.
LIBXSMM_C = """
#include <libxsmm.h>
#include <stdlib.h>
enum { BLOCK = 64 };

static int width(P *p) { return p->n < BLOCK ? p->n : BLOCK; }

int prepare(P *p, long count) {
  for (; count--; p++) {
    float one = 1, zero = 0;
    int m = width(p), n = p->m, k = p->k, out = p->n, none = LIBXSMM_GEMM_PREFETCH_NONE;
    int packed = p->low || p->right_t, lda = packed ? m : out, ldb = p->left_t && !p->low ? n : k;
    int flags = LIBXSMM_GEMM_FLAG_NONE;
    if (p->low) flags = LIBXSMM_GEMM_FLAG_VNNI_A;
    else if (p->left_t) flags = LIBXSMM_GEMM_FLAG_TRANS_B;
    p->made = p->low
        ? (void *)libxsmm_bsmmdispatch(m, n, k, &lda, &ldb, &out, &one, &zero, &flags, &none)
        : (void *)libxsmm_smmdispatch(m, n, k, &lda, &ldb, &out, &one, &zero, &flags, &none);
    if (!p->made || p->n % m) return 1;
  }
  return 0;
}

static void column(P *p, float *left, float *right, float *out) {
  for (long i = 0; i < p->m; i++) {
    float sum = 0;
    for (long j = 0; j < p->k; j++) sum += left[i * p->k + j] * right[j];
    out[i] = sum;
  }
}

static void block(P *p, long which, int at, unsigned short *turned) {
  static _Thread_local float pack[BLOCK * 1024] __attribute__((aligned(64)));
  int m = width(p), k = p->k, words = p->low ? k / 2 : k;
  float *right = (float *)p->right + which * words * p->n;
  float *left = (float *)p->left + which * words * p->m;
  float *out = (float *)p->out + which * p->m * p->n + at;
  if (p->n == 1 && !p->left_t) return column(p, left, right, out);
  if (p->right_t) {
    libxsmm_otrans(pack, right + (long)at * words, 4, words, m, words, m);
  } else if (p->low) {
    unsigned short *low = (unsigned short *)right + at;
    unsigned *pairs = (unsigned *)pack;
    for (int i = 0; i < words; i++, low += 2 * p->n)
      for (int j = 0; j < m; j++) pairs[i * m + j] = low[j] | (unsigned)low[p->n + j] << 16;
  }
  if (p->low) {
    unsigned short *rows = p->left_t ? turned + which * k * p->m : (unsigned short *)left;
    ((libxsmm_bsmmfunction)p->made)((void *)pack, (void *)rows, out);
  } else {
    ((libxsmm_smmfunction)p->made)(p->right_t ? pack : right + at, left, out);
  }
}

void run(P *p, long count) {
  static unsigned short turned[1 << 20] __attribute__((aligned(64)));
  for (; count--; p++) {
    long blocks = p->n / width(p), m = p->m, k = p->k, part = 32;
    if (p->low && p->left_t) {
      _Pragma("omp parallel for") for (long i = 0; i < p->pair * m / part; i++) {
        long which = i / (m / part), row = i % (m / part) * part;
        unsigned short *from = (unsigned short *)p->left + which * m * k;
        libxsmm_otrans(turned + which * m * k + row * k, from + row, 2, part, k, m, k);
      }
    }
    _Pragma("omp parallel for") for (long i = 0; i < p->pair * blocks; i++)
      block(p, i / blocks, i % blocks * width(p), turned);
  }
}
"""


class Layout(ctypes.Structure):
    """One product as the C programs see it: sizes, which sides are transposed, and places."""

    _fields_ = (
        *((name, ctypes.c_long) for name in ("pair", "m", "n", "k", "left_t", "right_t", "low")),
        *((name, ctypes.c_void_p) for name in ("left", "right", "out", "made")),
    )


class Work(NamedTuple):
    """One product with operands of its own, room for its result, and its layout."""

    left: Any
    right: Any
    out: Any
    layout: Any


Key = tuple[str, str, Product, int]  # a library, a precision, and which order of the sides
Call = Callable[[], Sequence[Any]]  # makes the products and gives their results
Library = Callable[[Product, Sequence[Work]], list[Call]]  # calls of which the quickest counts


def aligned(values: Any, dtype: Any) -> Any:
    """A copy that starts at a cache line."""
    room = np.empty(values.size * np.dtype(dtype).itemsize + 64, np.uint8)
    start = -room.ctypes.data % 64
    copy = room[start : room.size - 64 + start].view(dtype).reshape(values.shape)
    copy[...] = values
    return copy


def update_products(name: str, batch: int) -> Counter[Product]:
    """The matrix products of a cycle of updates; those of vectors, a thousandth, are left out."""
    config = resolve(name, "HalfCheetah-v5", {"batch_size": batch})
    spec = SPECS["HalfCheetah-v5"]
    learner = algorithms.find(config.run.algorithm).build(spec, config.hyper)
    rows = Rows(spec, len(learner.mask(np.random.default_rng(0))))
    key, shape = jax.random.key(0), (learner.updates_per_call, batch, rows.width)

    def update(state: Any, packed: Any) -> Any:
        minibatches = rows.unpack(packed)._replace(weight=jnp.ones(shape[:-1]))
        return learner.update(state, minibatches, key)

    packed = jax.ShapeDtypeStruct(shape, jnp.float32)
    traced = jax.make_jaxpr(update)(jax.eval_shape(learner.init, key), packed)
    counts: Counter[Product] = Counter()
    for product, times in products(traced.jaxpr):
        left, right, (_, (shared, _)) = product
        if len(left) == len(right) == 2 + len(shared):
            counts[product] += times
    return counts


def layout(product: Product) -> tuple[int, int, int, int, bool, bool]:
    """Networks, rows, columns, terms, and whether the left and the right side is transposed."""
    left, right, ((left_axes, right_axes), (shared, _)) = product
    left_t, right_t = left_axes[0] == len(shared), right_axes[0] == len(shared) + 1
    (m, k), n = left[-2:][:: -1 if left_t else 1], right[-2 if right_t else -1]
    return int(np.prod(left[:-2])), m, n, k, left_t, right_t


def is_small(product: Product) -> bool:
    """Whether bf16 leaves it float32."""
    return min(layout(product)[1:4]) < SMALL


def work(product: Product, precision: str, rng: np.random.Generator) -> Work:
    """A product of random operands."""
    pair, m, n, k, *turned = layout(product)
    low = precision == "bf16" and not is_small(product)
    dtype = jnp.bfloat16 if low else np.float32
    left, right = (aligned(rng.normal(size=shape), dtype) for shape in product[:2])
    out = aligned(np.zeros((*product[0][:-2], m, n)), np.float32)
    places = (array.ctypes.data for array in (left, right, out))
    return Work(left, right, out, Layout(pair, m, n, k, *turned, low, *places))


def error(results: Sequence[Any], works: Sequence[Work]) -> float:
    """The largest norm of results less NumPy's in float32, relative to these."""
    found: list[float] = []
    for result, one in zip(results, works, strict=True):
        left, right = (side.astype(np.float32) for side in (one.left, one.right))
        left = left.swapaxes(-1, -2) if one.layout.left_t else left
        true = left @ (right.swapaxes(-1, -2) if one.layout.right_t else right)
        found.append(float(np.linalg.norm(result - true) / np.linalg.norm(true)))
    return max(found)


def xla(way: str, product: Product, works: Sequence[Work]) -> list[Call]:
    """A program of XLA for each order of the sides, with this way's options."""
    options, pairs = WAYS[way], [(w.left, w.right) for w in works]
    other = [(right, left) for left, right in pairs]
    return [program(product, pairs, options), program(swapped(product), other, options)]


def program(product: Product, pairs: Any, options: dict[str, Any]) -> Call:
    """The products in one program of XLA."""
    dot = partial(
        jax.lax.dot_general,
        dimension_numbers=product[2],
        preferred_element_type=jnp.float32,
    )
    pairs = jax.tree.map(jnp.asarray, pairs)
    lowered = jax.jit(lambda pairs: [dot(a, b) for a, b in pairs]).lower(pairs)
    return partial(lowered.compile(compiler_options=options), pairs)


def native(made: Any, _: Product, works: Sequence[Work]) -> list[Call]:
    """A C program's products."""
    layouts, outs = (Layout * len(works))(*(w.layout for w in works)), [w.out for w in works]
    if made.prepare(layouts, len(works)):
        raise OSError("it refuses a product on this processor")

    def call() -> Sequence[Any]:
        made.run(layouts, ctypes.c_long(len(works)))
        return outs

    return [call]


def compiled(folder: str, source: str, *flags: str) -> Library:
    """A C program's library; OSError with what the compiler says of it."""
    path = str(Path(folder, f"{len(os.listdir(folder))}.so"))
    words = ["gcc", "-O3", "-march=native", "-ffast-math", "-fopenmp", "-shared", "-fPIC", "-xc"]
    tried = subprocess.run(
        [*words, "-", "-xnone", "-o", path, *flags],
        input=PRODUCT_C + source,
        capture_output=True,
        text=True,
    )
    if tried.returncode:
        raise OSError(next(line for line in tried.stderr.splitlines() if SAID.search(line)))
    return partial(native, ctypes.CDLL(path))


def way(name: str) -> Library:
    """A way of XLA, if this jaxlib knows its options and they are of use."""
    side = np.ones((1024, 1024), jnp.bfloat16)
    made: Any = program(
        (side.shape, side.shape, (((1,), (0,)), ((), ()))), [(side,) * 2], WAYS[name]
    )
    if "xla_cpu_use_onednn" in WAYS[name] and "__onednn" not in made.func.as_text():
        raise OSError(f"jax {jax.__version__} takes the options and makes no such call")
    return partial(xla, name)


def libraries(folder: str) -> Iterator[tuple[str, Library | str]]:
    """All by name, or why one is absent."""
    beside = (f"-I{sys.prefix}/include", f"-L{sys.prefix}/lib", f"-Wl,-rpath,{sys.prefix}/lib")
    debian = ("-lxsmm", "-lxsmmnoblas", "-ldl", "-lm", "-lpthread")
    builders: dict[str, Callable[[], Library]] = {
        **{name: partial(way, name) for name in WAYS},
        "oneDNN": partial(compiled, folder, ONEDNN_C, *beside, "-ldnnl"),
        "libxsmm": partial(compiled, folder, LIBXSMM_C, *debian),
    }
    for name, build in builders.items():
        try:
            yield name, build()
        except (OSError, jax.errors.JaxRuntimeError) as problem:
            yield name, str(problem).splitlines()[0]


def seconds(every: dict[Key, Call], rounds: int) -> dict[Key, float]:
    """The least that each call took. A round goes through all, so a busy spell spoils no call."""
    repeats = {name: max(1, round(SPAN / timed(call, 2))) for name, call in every.items()}
    best = dict.fromkeys(every, float("inf"))
    for _ in range(rounds):
        for name, call in every.items():
            best[name] = min(best[name], timed(call, repeats[name]))
    return best


def calls(
    product: Product, precision: str, present: dict[str, Library]
) -> tuple[dict[Key, Call], dict[str, float]]:
    """What to time of each library that can make a product, and the errors."""
    rng = np.random.default_rng(0)
    works = [work(product, precision, rng) for _ in range(TOGETHER)]
    every: dict[Key, Call] = {}
    errors: dict[str, float] = {}
    for name, library in present.items():
        with suppress(OSError):  # its row says so
            made = library(product, works)
            errors[name] = error(made[0](), works)
            every |= {(name, precision, product, order): call for order, call in enumerate(made)}
    return every, errors


def measure(rounds: int) -> dict[str, Any]:
    """For each library why it is absent, or by precision and batch its GFLOP/s, one for each of
    NAMES, and its largest error."""
    with TemporaryDirectory() as folder:
        results: dict[str, Any] = dict(libraries(folder))
        present: dict[str, Any] = {name: each for name, each in results.items() if callable(each)}
        results |= {name: {precision: {} for precision in PRECISIONS} for name in present}
        for batch in BATCHES:
            sets = [update_products(name, batch) for name in NAMES]
            every: dict[Key, Call] = {}
            errors: dict[tuple[str, str], list[float]] = defaultdict(list)
            for product in set[Product]().union(*sets):
                for precision in ("f32",) if is_small(product) else PRECISIONS:
                    more, wrong = calls(product, precision, present)
                    every |= more
                    for name, value in wrong.items():
                        errors[name, precision].append(value)
            best = seconds(every, rounds)
            for name, precision in errors:
                took = least(best, name, precision)
                if took.keys() >= set[Product]().union(*sets):
                    rates = [rate(each, took) for each in sets]
                    results[name][precision][batch] = (rates, max(errors[name, precision]))
        return results


def least(best: dict[Key, float], name: str, precision: str) -> dict[Product, float]:
    """Seconds a product of the quicker order, small ones in float32."""
    took: dict[Product, float] = {}
    for (other, own, product, _), each in best.items():
        if other == name and own == ("f32" if is_small(product) else precision):
            took[product] = min(each / TOGETHER, took.get(product, each))
    return took


def rate(counts: Counter[Product], took: dict[Product, float]) -> float:
    """GFLOP/s of a set of products."""
    work = sum(flops(product) * times for product, times in counts.items())
    return work / sum(took[product] * times for product, times in counts.items()) / 1e9


def updates(rounds: int) -> list[list[Any]]:
    """Name, batch, and for each of KINDS the most updates/s and the ratio to XLA in float32.

    They take turns in this process, each for a few hundredths of a second.
    """
    for name in LIBRARIES:
        if not loaded(name):
            raise SystemExit(f"products.py: {name} is not built in (docs/products.md)")
    found: list[list[Any]] = []
    for name, batch in itertools.product(NAMES, BATCHES[:-1]):
        cycles: list[tuple[Callable[[], Any], int]] = []
        for precision, value in KINDS:
            os.environ[VARIABLE] = value
            spec = SPECS["HalfCheetah-v5"]
            call, _, made = whole(name, spec, 1, batch_size=batch, precision=precision)
            timed(call, 3)
            cycles.append((call, made))
        rates = np.array(
            [[made / timed(call, 16 // made) for call, made in cycles] for _ in range(rounds)]
        ).max(axis=0)
        found.append([name, batch, *(f"{rate:.0f} ({rate / rates[0]:.2f})" for rate in rates)])
    return found


def on_cores(cores: int, rounds: int, what: str = "--measure") -> Any:
    """What `measure` or `updates` finds in a process of its own on so many cores."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[-cores:])  # which the process inherits
    words = [sys.executable, __file__, what, "--measure", "--rounds", str(rounds)]
    environment = {**os.environ, "NPROC": str(cores), "OMP_NUM_THREADS": str(cores)}
    environment["JAX_PLATFORMS"] = "cpu"
    done = subprocess.run(words, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    os.sched_setaffinity(0, before)
    return json.loads(done.stdout)


def ratios(results: dict[str, Any], name: str, precision: str, base: str) -> dict[str, float]:
    """A library's speed over XLA's in precision `base` by batch, the mean of the updates."""
    xla = results["XLA"][base]
    return {
        batch: float(gmean(np.divide(rates, xla[batch][0])))
        for batch, (rates, _) in results[name][precision].items()
    }


def rows(results: dict[str, Any], cores: int) -> Iterator[list[str]]:
    """Lines of the table."""
    for name, found in results.items():
        if isinstance(found, str):
            yield [name, "", str(cores), f"absent: {found}"]
            continue
        for precision, batches in found.items():
            over = ratios(results, name, precision, "f32")
            cells = [
                f"{' / '.join(f'{rate:.0f}' for rate in rates)} ({over[batch]:.2f})"
                for batch, (rates, _) in batches.items()
            ]
            if not cells:
                yield [name, precision, str(cores), "absent: not on this processor"]
                continue
            worst = max(wrong for _, wrong in batches.values())
            yield [name, precision, str(cores), *cells, f"{worst:.0e}"]


def verdicts(results: dict[str, Any], cores: int) -> Iterator[str]:
    """Who reaches which goal, in words."""
    for name, precision in itertools.product(results, PRECISIONS):
        if isinstance(results[name], str) or name == "XLA" or not results[name][precision]:
            continue
        over = ratios(results, name, precision, precision)
        least, goal = min(over[str(batch)] for batch in DECISIVE), GOALS[precision, cores]
        worst = max(wrong for _, wrong in results[name][precision].values())
        word = "wrong" if worst > WRONG[precision] else "go" if least >= goal else "no-go"
        yield f"{word}: {name}, {precision}, cores {cores}: {least:.2f} of {goal} times XLA"


def main() -> None:
    """Print the table, then for each library whether it is worth its while."""
    parser = argparse.ArgumentParser(description="Time the products of updates.")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--updates", action="store_true", help="time whole updates, in every way")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.measure:
        json.dump((updates if chosen.updates else measure)(chosen.rounds), sys.stdout)
        return
    counts = [cores for cores in (1, 2) if cores <= len(os.sched_getaffinity(0))]
    if chosen.updates:
        rows_of = {cores: on_cores(cores, chosen.rounds, "--updates") for cores in counts}
        lines = [[cores, *row] for cores, found in rows_of.items() for row in found]
        kinds = [f"{value}, {precision}" for precision, value in KINDS]
        headers = ["cores", "algorithm", "batch", *kinds]
        print(tabulate(lines, headers, "github", disable_numparse=True))
        return
    every = {cores: on_cores(cores, chosen.rounds) for cores in counts}
    processor = subprocess.run("lscpu", capture_output=True, text=True, check=True).stdout
    print(*(line for line in processor.splitlines() if "Model" in line), sep="\n")
    print(f"GFLOP/s of all products of an update, {' / '.join(NAMES)} (times XLA in f32)\n")
    headers = ["library", "precision", "cores", *(f"batch {batch}" for batch in BATCHES), "error"]
    lines = [row for cores, results in every.items() for row in rows(results, cores)]
    print(tabulate(lines, headers, "github", disable_numparse=True), end="\n\n")
    print(*(line for cores, found in every.items() for line in verdicts(found, cores)), sep="\n")


if __name__ == "__main__":
    main()
