#!/usr/bin/env python3
"""Where the golden vectors of this folder come from. Nothing runs this file: not the build, not the tests, not `wodtem`.

It shares no code with the project: equations written again, in NumPy and PyTorch, in float64, in the plainest form that
each has, with gradients by PyTorch's autograd; the physics by MuJoCo's own library through a few lines of C. The files
were made on 2026-11-24 by Debian 12's python3 3.11.2, python3-numpy 1.24.2, python3-torch 1.13.0a0 and libmujoco 2.2.2:

    python3 tests/vectors/peer.py            # writes every file beside it
    python3 tests/vectors/peer.py linear     # or those named

README.md beside it says what is in the files. Inputs follow one rule, paint(), unless a case needs exact values.
"""
import json
import math
import os
import sys

import numpy as np
import torch

torch.set_default_dtype(torch.float64)
torch.set_num_threads(1)
HERE = os.path.dirname(os.path.abspath(__file__))
U = 2.0**-24  # one rounding of float32, relative
TORCH = "float64 peer: PyTorch " + torch.__version__
NUMPY = "float64 peer: NumPy " + np.__version__
CLOSED = "closed form"
SEARCH = "exhaustive search"


def paint(seed, *shape, scale=1.0):
    """(((i + seed) * 37) mod 251 - 125) / 128: exact in float32 and bfloat16, no two neighbours equal, period 251.
    `scale`: a power of two."""
    i = np.arange(int(np.prod(shape)))
    return ((((i + seed) * 37) % 251 - 125) / 128.0 * scale).reshape(shape)


# ----------------------------------------------------------------------------------------------------------------------
# Files: safetensors, written by hand: 8 bytes of length, JSON, data.

DTYPES = {"float32": "F32", "float64": "F64", "uint8": "U8", "uint32": "U32", "uint64": "U64", "int32": "I32",
          "int64": "I64", "bool": "BOOL"}


class File:
    def __init__(self, topic, equations):
        self.metadata = {"topic": topic, "equations": equations}
        self.tensors = {}
        self.cases = 0

    def case(self, name, note, tolerance, source, inputs, outputs, **settings):
        """Inputs that float32 holds are stored so, results in float64, whole numbers as whole numbers."""
        self.cases += 1
        for key, text in dict(settings, note=note, tolerance=tolerance, source=source).items():
            self.metadata[name + "." + key.replace("__", "/")] = str(text)
        for part, tensors in (("in", inputs), ("out", outputs)):
            for key, value in tensors.items():
                if isinstance(value, torch.Tensor):
                    value = value.detach().numpy()
                value = np.asarray(value)
                if part == "in" and value.dtype == np.float64:
                    with np.errstate(over="ignore"):
                        short = value.astype(np.float32)
                    if np.array_equal(short.astype(np.float64), value, equal_nan=True):
                        value = short
                if part == "out" and value.dtype.kind in "iub" and not tolerance.startswith("exact"):
                    self.tolerance(name, key, "exact: whole numbers")
                self.tensors[f"{name}/{part}/{key}"] = value

    def tolerance(self, case, output, text):
        self.metadata[f"{case}.tolerance.{output}"] = text

    def save(self):
        self.metadata["cases"] = str(self.cases)
        header, data = {"__metadata__": self.metadata}, b""
        for name, value in self.tensors.items():
            raw = value.astype(value.dtype.newbyteorder("<")).tobytes()
            header[name] = {"dtype": DTYPES[value.dtype.name], "shape": list(value.shape),
                            "data_offsets": [len(data), len(data) + len(raw)]}
            data += raw
        text = json.dumps(header, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 8)
        path = os.path.join(HERE, self.metadata["topic"] + ".safetensors")
        with open(path, "wb") as file:
            file.write(len(text).to_bytes(8, "little") + text + data)
        print(f"{os.path.basename(path):34} {self.cases:3} cases {8 + len(text) + len(data):7} bytes")


def tensor(x):
    return torch.tensor(np.asarray(x, dtype=np.float64), requires_grad=True)


def roundings(k, magnitude, results, reason):
    """A tolerance: k roundings of float32 in a row, of terms whose absolute values add up to `magnitude`, against the
    largest of the results; float64 has the issue's own bounds."""
    scale = min(float(torch.as_tensor(r).detach().abs().max()) for r in results)
    bound = k * U * float(magnitude) / scale
    return f"float64 1e-12, float32 {bound:.2g}: {reason}"


def gradients(outputs, upstream, variables):
    """d(sum of upstream * output)/d(variable), by autograd."""
    loss = sum((torch.tensor(u) * y).sum() for y, u in zip(outputs, upstream))
    return {"gradient/" + name: g for name, g in zip(variables, torch.autograd.grad(loss, list(variables.values())))}


# ----------------------------------------------------------------------------------------------------------------------
# rng. Philox4x32-10 from Salmon, Moraes, Dror and Shaw, SC 2011, in Python's whole numbers.


def philox(counter, key):
    c, (k0, k1) = list(counter), key
    for _ in range(10):
        p0, p1 = 0xD2511F53 * c[0], 0xCD9E8D57 * c[2]
        c = [(p1 >> 32) ^ c[1] ^ k0, p1 & 0xFFFFFFFF, (p0 >> 32) ^ c[3] ^ k1, p0 & 0xFFFFFFFF]
        k0, k1 = (k0 + 0x9E3779B9) & 0xFFFFFFFF, (k1 + 0xBB67AE85) & 0xFFFFFFFF
    return c


def rng():
    f = File("rng", "none: the source of all chance")
    ones = 0xFFFFFFFF
    known = [([0] * 4, [0] * 2, [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
             ([ones] * 4, [ones] * 2, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
             ([0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344], [0xA4093822, 0x299F31D0],
              [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1])]
    for counter, key, words in known:
        assert philox(counter, key) == words
    u32 = lambda x: np.array(x, dtype=np.uint32)
    f.case("published", "Philox4x32-10 itself: nine rounds, another constant, words in another order",
           "exact: whole numbers", "published: Random123's kat_vectors",
           {"counter": u32([k[0] for k in known]), "key": u32([k[1] for k in known])},
           {"words": u32([k[2] for k in known])})
    counters = [[i, 3, 5 + i, 7] for i in range(4)]
    f.case("counters", "a block of counters: a carry from one word into the next, of which there is none",
           "exact: whole numbers", "another implementation, in Python's whole numbers",
           {"counter": u32([[0xFFFFFFFE + i & ones, 9, 0, 0] for i in range(4)] + counters),
            "key": u32([[1, 2]] * 8)},
           {"words": u32([philox([0xFFFFFFFE + i & ones, 9, 0, 0], [1, 2]) for i in range(4)] +
                         [philox(c, [1, 2]) for c in counters])})

    seed, stream = 12345, 3
    index, step, site = [0, 1, 2, 3, 70, 4294967295], [0, 1, 2**33 + 5, 7, 7, 7], [0, 0, 1, 1048576, 2, 4294967295]
    words = [philox([i, s, t & ones, t >> 32], [seed, stream]) for i, t, s in zip(index, step, site)]
    draws = {"index": np.array(index, dtype=np.int64), "step": np.array(step, dtype=np.int64),
             "site": np.array(site, dtype=np.int64)}
    setting = {"seed": seed, "stream": stream}
    long = [w[1] << 32 | w[0] for w in words]
    f.case("uniform", "the counter is (index, site, step low, step high), the key (seed, stream); 53 bits of words 1 and "
           "0: swapped words, 32 bits alone, division by 2^64 - 1", "exact: multiples of 2^-53", CLOSED, draws,
           {"uniform": np.array([(x >> 11) / 2.0**53 for x in long])}, **setting)
    bounds = [1, 3, 10, 750, 4294967297, 3 * 2**61]
    f.case("below", "modulo_bias: the high half of the 128-bit product, not a remainder; bounds that are no power of two",
           "exact: whole numbers", CLOSED, dict(draws, bound=np.array(bounds, dtype=np.uint64)),
           {"below": np.array([x * b >> 64 for x, b in zip(long, bounds)], dtype=np.uint64)}, **setting)
    u, angle = [((w[2] >> 8) + 1) / 2.0**24 for w in words], [(w[3] >> 8) / 2.0**24 * 2 * math.pi for w in words]
    f.case("normal", "Box and Muller from words 2 and 3: the sine for the cosine, u = 0 (24 bits, plus one), degrees",
           f"float32 {8 * 2 * math.pi * U:.2g}: the angle, up to 2 pi, is rounded three times, and each function once",
           CLOSED, draws, {"normal": np.array([math.sqrt(-2 * math.log(a)) * math.cos(b) for a, b in zip(u, angle)])},
           **setting)
    f.save()


# ----------------------------------------------------------------------------------------------------------------------
# returns, from their definitions as sums, not by recursion.


def sums(rewards, gamma):
    return np.array([math.fsum(gamma**(j - t) * rewards[j] for j in range(t, len(rewards))) for t in range(len(rewards))])


def returns():
    f = File("returns", "WODTEM sec. III-A: g_t, d_t")
    exact = "float64 1e-12, float32 1.2e-07: a sum in double of rewards in float32; scaled_g is rounded once"

    def case(name, note, rewards, gamma=0.99, lengths=None, scale=1.0):
        rewards = np.float32(rewards).astype(np.float64)
        parts = np.split(rewards, np.cumsum(lengths)[:-1]) if lengths else [rewards]
        inputs = {"rewards": rewards}
        if lengths:
            inputs["lengths"] = np.array(lengths)
        g = np.concatenate([sums(p, 1.0) for p in parts])
        f.case(name, note, exact, CLOSED, inputs,
               {"g": g, "d": np.concatenate([sums(p, gamma) for p in parts]), "scaled_g": g * scale},
               gamma=gamma, reward_scale=scale)

    r = paint(3, 12)
    case("off_by_one", "off_by_one: g_t and d_t begin with r_t, undiscounted", r)
    case("gamma_one", "gamma 1: d is g", r, gamma=1.0)
    case("gamma_zero", "gamma 0: d_t is r_t alone (0^0 is 1)", r, gamma=0.0)
    case("one_step", "a trajectory of one step", [0.75])
    case("scaled_twice", "scaled_twice: the reward scale reaches the network's g alone, never g or d", r, scale=0.001)
    case("several", "a sum that runs on into the next trajectory", r, lengths=[1, 4, 5, 2])
    case("cut_by_time_limit", "a bootstrapped tail: the last reward ends the sum, whatever ended the trajectory",
         np.ones(100))
    case("long", "summed in float32, or powers of gamma that drift", np.resize(paint(7, 251), 1000) * 100)
    f.save()


# ----------------------------------------------------------------------------------------------------------------------
# linear, layernorm, mlp


def linear():
    f = File("linear", "none: ODT's Linear and GPT-2's Conv1D")

    def case(name, note, n, i, o, layout="out_in", scale=1.0):
        x, b, up = tensor(paint(1, n, i, scale=scale)), tensor(paint(5, o)), paint(9, n, o)
        w = tensor(paint(2, o, i) if layout == "out_in" else paint(2, i, o))
        y = x @ (w.T if layout == "out_in" else w) + b
        g = gradients([y], [up], {"x": x, "weight": w, "bias": b})
        largest = max((x.abs() @ (w.abs().T if layout == "out_in" else w.abs()) + b.abs()).max() / y.abs().max(),
                      *((a / c.abs().max()) for a, c in (
                          ((torch.tensor(np.abs(up)) @ (w.abs() if layout == "out_in" else w.abs().T)).max(),
                           g["gradient/x"]),
                          ((x.abs().T @ torch.tensor(np.abs(up))).max(), g["gradient/weight"]),
                          (np.abs(up).sum(0).max(), g["gradient/bias"]))))
        k = max(n, i, o) + 1
        f.case(name, note, f"float64 1e-12, float32 {k * U * float(largest):.2g}: {k} roundings of the sum of |products|",
               TORCH, {"x": x, "weight": w, "bias": b, "upstream": up}, dict({"y": y}, **g), layout=layout)

    case("plain", "transposed weight; bias left out; gradients summed over the wrong axis", 5, 3, 4)
    case("conv1d_transposed", "conv1d_transposed: GPT-2's Conv1D keeps [in, out], Linear [out, in]", 5, 3, 4, "in_out")
    case("square", "a square weight, where the two layouts cannot be told by shape", 3, 4, 4)
    case("square_conv1d", "the same weight, the other layout, another result", 3, 4, 4, "in_out")
    case("one_row", "one row, as in acting", 1, 7, 5)
    case("one_column", "one input number, as of embed_return", 6, 1, 8)
    case("tiles", "edges of tiles: sizes that are multiples of nothing", 13, 33, 37)
    case("sum_blocks", "sums of more than 256 products", 2, 300, 3)
    f.save()


def layer_norm(x, weight, bias):
    """Over the last axis, from its definition."""
    mean = x.mean(-1, keepdim=True)
    variance = ((x - mean)**2).mean(-1, keepdim=True)
    return (x - mean) / torch.sqrt(variance + 1e-5) * weight + bias


def layernorm():
    f = File("layernorm", "none: ODT's LayerNorm")

    def case(name, note, x, k=None, weight=None, bias=None):
        n, d = x.shape
        x = tensor(x)
        w = tensor(paint(4, d) if weight is None else weight)
        b = tensor(paint(6, d) if bias is None else bias)
        up = paint(9, n, d)
        y = layer_norm(x, w, b)
        # x - mean loses |x| / deviation to cancellation; the rest is about d + 8 roundings of numbers of the size of y.
        loss = (x.abs().max(-1).values / torch.sqrt(x.var(-1, unbiased=False) + 1e-5)).max() + 1
        bound = (d + 8) * U * float(loss) * 2
        f.case(name, note, f"float64 1e-12, float32 {bound:.2g}: 2 ({d} + 8) roundings, times |x| / deviation, which "
               "x - mean loses to cancellation", TORCH,
               {"x": x, "weight": w, "bias": b, "upstream": up},
               dict({"y": y}, **gradients([y], [up], {"x": x, "weight": w, "bias": b})))

    case("plain", "variance_ddof1: the variance divides by d, not by d - 1; weight and bias exchanged", paint(1, 4, 8))
    case("epsilon_outside_root", "epsilon_outside_root: sqrt(variance + 1e-5), where the variance is 1e-5 itself",
         paint(1, 3, 8, scale=2.0**-8))
    case("constant_row", "a row without variance: y is the bias, no division by 0",
         np.concatenate([np.full((1, 8), 0.5), paint(1, 2, 8), np.zeros((1, 8))]))
    case("large_mean", "E[x^2] - E[x]^2, which has no digits left", paint(1, 3, 8) + 512.0)
    case("one_column", "one number a row", paint(1, 3, 1))
    case("wide", "a row that is no multiple of a vector", paint(1, 2, 37))
    f.save()


def mlp():
    f = File("mlp", "none: GPT-2's MLP with ReLU")

    def case(name, note, x, w1, b1, w2, b2):
        values = [tensor(v) for v in (x, w1, b1, w2, b2)]
        x, w1, b1, w2, b2 = values
        h = torch.clamp(x @ w1 + b1, min=0)  # slope at 0: see below
        y = h @ w2 + b2
        up = paint(9, *y.shape)
        # By hand: autograd's slope of clamp at 0 is 1, ReLU's is 0.
        dy = torch.tensor(up)
        dh = (dy @ w2.T) * (x @ w1 + b1 > 0)
        g = {"x": dh @ w1.T, "c_fc.weight": x.T @ dh, "c_fc.bias": dh.sum(0), "c_proj.weight": h.T @ dy,
             "c_proj.bias": dy.sum(0)}
        k = x.shape[1] + w1.shape[1] + x.shape[0] + 4
        sizes = [((x.abs() @ w1.abs() + b1.abs()) @ w2.abs() + b2.abs()).max() / y.abs().max()]
        for size, result in (((dy.abs() @ w2.abs().T @ w1.abs().T).max(), g["x"]),
                             ((x.abs().T @ (dy.abs() @ w2.abs().T)).max(), g["c_fc.weight"]),
                             ((dy.abs() @ w2.abs().T).sum(0).max(), g["c_fc.bias"]),
                             (((x.abs() @ w1.abs() + b1.abs()).T @ dy.abs()).max(), g["c_proj.weight"]),
                             (dy.abs().sum(0).max(), g["c_proj.bias"])):
            if result.abs().max() > 0:
                sizes.append(size / result.abs().max())
        f.case(name, note, f"float64 1e-12, float32 {k * U * float(max(sizes)):.2g}: {k} roundings of the sum of |products|",
               TORCH, {"x": x, "c_fc.weight": w1, "c_fc.bias": b1, "c_proj.weight": w2, "c_proj.bias": b2, "upstream": up},
               dict({"y": y}, **{"gradient/" + n: v for n, v in g.items()}))

    d = 4
    case("plain", "GELU for ReLU; a weight transposed", paint(1, 5, d), paint(2, d, 4 * d), paint(3, 4 * d),
         paint(4, 4 * d, d), paint(5, d))
    w1 = paint(2, d, 4 * d)
    w1[:, ::2] = 0  # every other hidden unit is exactly 0, or its bias
    b1 = paint(3, 4 * d)
    b1[::4] = 0
    case("relu_at_zero", "relu_at_zero: the slope at exactly 0 is 0", paint(1, 5, d), w1, b1, paint(4, 4 * d, d),
         paint(5, d))
    case("all_negative", "nothing passes: y is the bias, the gradient of x is 0 but that of c_proj.bias is not",
         paint(1, 3, d), paint(2, d, 8, scale=0.125), np.full(8, -4.0), paint(4, 8, d), paint(5, d))
    f.save()


# ----------------------------------------------------------------------------------------------------------------------
# attention


def attend(q, k, v, lengths, heads):
    """Causal attention of packed sequences, one query, one head at a time."""
    n, d = q.shape
    size, first, rows = d // heads, 0, []
    for length in lengths:
        for i in range(first, first + length):
            row = []
            for h in range(heads):
                c = slice(h * size, (h + 1) * size)
                scores = k[first:i + 1, c] @ q[i, c] / math.sqrt(size)
                row.append(torch.softmax(scores, 0) @ v[first:i + 1, c])
            rows.append(torch.cat(row))
        first += length
    return torch.stack(rows)


def attention():
    f = File("attention", "none: GPT-2's causal attention")

    def case(name, note, n, d, heads=1, lengths=None, scale=1.0, q=None, k=None):
        lengths = lengths or [n]
        q = tensor(paint(1, n, d, scale=scale) if q is None else q)
        k, v, up = tensor(paint(70, n, d) if k is None else k), tensor(paint(140, n, d)), paint(9, n, d)
        y = attend(q, k, v, lengths, heads)
        g = gradients([y], [up], {"q": q, "k": k, "v": v})
        size, root = d // heads, math.sqrt(d // heads)
        logits = max(float((q[:, i:i + size].abs() @ k[:, i:i + size].abs().T).max()) for i in range(0, d, size)) / root
        weight = 2 * (size + 3) * logits + max(lengths) + 8  # roundings of a weight, relative
        bound = 0.0
        through = 2 * float((torch.tensor(np.abs(up)) @ v.abs().T).max())  # |gradient of a weight|
        for result, magnitude in ((y, v.abs().max()), (g["gradient/v"], np.abs(up).sum(0).max()),
                                  (g["gradient/q"], through * k.abs().max() / root),
                                  (g["gradient/k"], through * q.abs().sum(0).max() / root)):
            if result.abs().max() > 0:
                bound = max(bound, 2 * (weight + size + n) * U * float(magnitude) / float(result.abs().max()))
        f.case(name, note, f"float64 {max(1e-12, bound * 2**-29):.2g}, float32 {bound:.2g}: a weight takes "
               f"{weight:.0f} roundings, of which each logit's size counts; twice {size} + {n} more", TORCH,
               {"q": q, "k": k, "v": v, "lengths": np.array(lengths), "upstream": up}, dict({"y": y}, **g), heads=heads)

    case("scale_by_head_dim", "scale_by_head_dim: logits over the root of the head's size, not of the width", 5, 8, 4)
    case("one_head", "one head", 5, 8, 1)
    case("one_token", "one token: the value itself, and no gradient for q and k", 1, 8, 2)
    case("causal_strict", "causal_strict: a token sees itself; a token sees what follows it", 4, 4, 2)
    case("neighbour_sequence_leak", "neighbour_sequence_leak: packed sequences see nothing of each other", 10, 8, 2,
         [1, 5, 3, 1])
    case("huge_logits", "logits of +-80: exp without the largest subtracted overflows in float32 and, at 800, in float64",
         6, 4, 1, None, 64.0)
    # The largest logit lies beyond -10000: whoever adds -10000 to what is masked lets it through.
    case("mask_minus_10000", "mask_minus_10000: what is masked weighs exactly 0, however small the rest",
         3, 2, 1, None, 1.0, np.array([[128.0, 0.0], [128.0, 0.0], [0.0, 1.0]]),
         np.array([[-256.0, 0.0], [0.0, 1.0], [256.0, 0.0]]))
    case("wide_heads", "heads that are no multiple of a vector", 7, 38, 2)
    f.save()


# ----------------------------------------------------------------------------------------------------------------------
# The network, as ODT's model computes it (pre-LN GPT-2 with ReLU), one window at a time and every token of it, the last
# action too. Nothing here is packed, left out or fused.


def parameter_shapes(state_dim, action_dim, layers, d, head="gaussian", positions=0):
    shapes = {"embed_return.weight": (d, 1), "embed_return.bias": (d,), "embed_state.weight": (d, state_dim),
              "embed_state.bias": (d,), "embed_action.weight": (d, action_dim), "embed_action.bias": (d,),
              "embed_ln.weight": (d,), "embed_ln.bias": (d,)}
    for layer in range(layers):
        h = f"transformer.h.{layer}."
        shapes.update({h + "ln_1.weight": (d,), h + "ln_1.bias": (d,), h + "attn.c_attn.weight": (d, 3 * d),
                       h + "attn.c_attn.bias": (3 * d,), h + "attn.c_proj.weight": (d, d), h + "attn.c_proj.bias": (d,),
                       h + "ln_2.weight": (d,), h + "ln_2.bias": (d,), h + "mlp.c_fc.weight": (d, 4 * d),
                       h + "mlp.c_fc.bias": (4 * d,), h + "mlp.c_proj.weight": (4 * d, d), h + "mlp.c_proj.bias": (d,)})
    shapes.update({"transformer.ln_f.weight": (d,), "transformer.ln_f.bias": (d,)})
    for name in {"gaussian": ["mu", "log_std"], "categorical": ["logits"], "deterministic": ["0"]}[head]:
        shapes.update({f"predict_action.{name}.weight": (action_dim, d), f"predict_action.{name}.bias": (action_dim,)})
    if positions:
        shapes["embed_ordering.weight"] = (positions, d)
    return shapes


def painted_parameters(shapes, scale=0.25):
    """Weights of +-1/4, LayerNorm's gains about 1; each tensor its own seed."""
    p = {}
    for seed, (name, shape) in enumerate(shapes.items()):
        p[name] = paint(seed * 17, *shape, scale=scale)
        if ("ln_" in name or "embed_ln" in name) and name.endswith("weight"):
            p[name] = p[name] + 1
    return {name: torch.tensor(value, requires_grad=True) for name, value in p.items()}


def network(p, windows, heads):
    """windows: (R [C], s [C, S], a [C, A], t [C]) each. Returns the outputs of all layers as a list of windows, and
    which of their rows a packed computation has: all tokens but the last action, or the state tokens alone."""
    layers = [name.split(".")[2] for name in p if name.endswith("attn.c_attn.weight")]
    outputs, every, asking = {}, [], []
    for R, s, a, t in windows:
        C, d = len(R), p["embed_ln.weight"].shape[0]
        time = 0
        if "embed_ordering.weight" in p:
            table = p["embed_ordering.weight"]
            time = table[np.minimum(t, table.shape[0] - 1)]
        e = [R[:, None] @ p["embed_return.weight"].T + p["embed_return.bias"] + time,
             s @ p["embed_state.weight"].T + p["embed_state.bias"] + time,
             a @ p["embed_action.weight"].T + p["embed_action.bias"] + time]
        x = torch.stack(e, 1).reshape(3 * C, d)
        put = lambda name, x: outputs.setdefault(name, []).append(x) or x
        put("embed", x)
        x = put("embed_ln", layer_norm(x, p["embed_ln.weight"], p["embed_ln.bias"]))
        mask = torch.full((3 * C, 3 * C), -math.inf).triu(1)
        for layer in layers:
            h = f"transformer.h.{layer}"
            g = lambda name: (p[f"{h}.{name}.weight"], p[f"{h}.{name}.bias"])
            w, b = g("attn.c_attn")
            q, k, v = (layer_norm(x, *g("ln_1")) @ w + b).split(d, 1)
            cut = lambda z: z.reshape(3 * C, heads, d // heads).transpose(0, 1)
            weights = torch.softmax(cut(q) @ cut(k).transpose(1, 2) / math.sqrt(d // heads) + mask, -1)
            y = (weights @ cut(v)).transpose(0, 1).reshape(3 * C, d)
            w, b = g("attn.c_proj")
            x = put(h + ".attn", x + y @ w + b)
            w, b = g("mlp.c_fc")
            hidden = torch.relu(layer_norm(x, *g("ln_2")) @ w + b)
            w, b = g("mlp.c_proj")
            x = put(h, x + hidden @ w + b)
        x = put("transformer.ln_f", layer_norm(x, p["transformer.ln_f.weight"], p["transformer.ln_f.bias"]))
        states = x[1::3]  # the action is read from the state's token
        head = lambda name: states @ p[f"predict_action.{name}.weight"].T + p[f"predict_action.{name}.bias"]
        if "predict_action.mu.weight" in p:
            put("policy.mean", head("mu"))
            put("policy.log_std", -5 + 3.5 * (torch.tanh(head("log_std")) + 1))
        elif "predict_action.logits.weight" in p:
            put("policy.mean", torch.log_softmax(head("logits"), -1))
        else:
            put("policy.mean", torch.tanh(head("0")))
        every.append(np.arange(3 * C - 1))
        asking.append(np.arange(1, 3 * C, 3))
    last = f"transformer.h.{layers[-1]}" if layers else ""
    rows = {name: asking if name in (last, last + ".attn", "transformer.ln_f") else
            [np.arange(len(x)) for x in outputs[name]] if name.startswith("policy") else every for name in outputs}
    return outputs, rows


def packed(parts, rows):
    return torch.cat([part[r] for part, r in zip(parts, rows)])


def split_windows(lengths, *arrays):
    ends = np.cumsum(lengths)
    return [tuple(torch.tensor(a[e - n:e]) if a.dtype.kind == "f" else a[e - n:e] for a in arrays)
            for n, e in zip(lengths, ends)]


def tokens():
    f = File("tokens", "WODTEM sec. III-A: s_{-C,t}, g_{-C,t}; DT sec. 3: the order R, s, a")

    def case(name, note, lengths, positions=0, timesteps=None, last_action=None, held=("embed", "embed_ln"), head="gaussian",
             state_dim=3, action_dim=2, d=4, layers=1):
        n = sum(lengths)
        p = painted_parameters(parameter_shapes(state_dim, action_dim, layers, d, head, positions))
        R, s, a = paint(11, n), paint(1, n, state_dim), paint(50, n, action_dim)
        t = np.concatenate([np.arange(m) for m in lengths]) if timesteps is None else np.array(timesteps)
        inputs = {"parameter/" + k: v for k, v in p.items()}
        if head == "categorical":
            moves = (np.arange(n) * 3 + 1) % action_dim
            a, inputs["actions"] = np.eye(action_dim)[moves], moves
        else:
            shown = a.copy()
            if last_action is not None:
                shown[np.cumsum(lengths) - 1] = last_action
            inputs["actions"] = shown
        inputs.update({"returns_to_go": R, "states": s, "lengths": np.array(lengths)})
        if timesteps is not None:
            inputs["timesteps"] = t
        outputs, rows = network(p, split_windows(lengths, R, s, a, t), 2)
        results = {"layer/" + name: packed(outputs[name], rows[name]) for name in held}
        k = 8 * (max(state_dim, action_dim) + d + 8) * (1 + 8 * layers * (len(held) > 2))
        f.case(name, note, f"float64 1e-11, float32 {k * U:.2g}: {k} roundings, those of sums and those a LayerNorm enlarges",
               TORCH, inputs, results, heads=2)

    case("order", "the order R, s, a; another layer's weight for a token; the last action of a window is no token",
         [3])
    case("one_step", "C = 1: R and s alone", [1])
    case("packed", "several lengths packed: a window of one step, then full ones", [1, 3, 2, 1])
    case("positions", "one row of the table for all three tokens of a step; positions count time-steps, not tokens",
         [3, 2], 6, [0, 1, 2, 3, 4])
    case("timestep_clipped", "timestep_clipped: beyond the table's end its last row serves", [2, 2], 4, [2, 3, 4, 999])
    case("action_leak", "action_leak: the prediction of a_c does not see a_c; the last action is not read at all",
         [3, 1], 0, None, math.nan, ("embed", "transformer.h.0", "policy.mean", "policy.log_std"))
    case("neighbour_sequence_leak", "neighbour_sequence_leak: a window's predictions do not depend on the others",
         [2, 1, 3], 0, None, None, ("policy.mean", "policy.log_std"))
    case("one_hot", "a discrete action is a token one-hot", [3, 1], 0, None, None, ("embed", "policy.mean"), "categorical",
         2, 4)
    case("deterministic", "DT's head: tanh of predict_action.0, positions in use", [2, 2], 5, None, None,
         ("embed", "policy.mean"), "deterministic")
    f.save()


# ----------------------------------------------------------------------------------------------------------------------
# Policy heads. log(1 - tanh(u)^2) = -2 log cosh(u), the density of N(m, s^2) at atanh(a).


def log_cosh(u):
    return u.abs() + torch.log1p(torch.exp(-2 * u.abs())) - math.log(2)


def gaussian_log_prob(mean, log_std, actions):
    u = 0.5 * (torch.log1p(actions) - torch.log1p(-actions))
    z = (u - mean) * torch.exp(-log_std)
    return (-0.5 * z**2 - log_std - 0.5 * math.log(2 * math.pi) - torch.log1p(-actions * actions)).sum(-1)


def gaussian_entropy(mean, log_std, noise):
    u = mean + torch.exp(log_std) * noise
    return (0.5 * noise**2 + log_std + 0.5 * math.log(2 * math.pi) - 2 * log_cosh(u)).sum(-1)


def policy_gaussian():
    f = File("policy_gaussian", "WODTEM eq. (2), WODTEM eq. (3): log pi and H; ODT's squashed Gaussian")

    def case(name, note, mean, log_std=None, raw=None, actions=None, noise=None, **more):
        variables = {"mean": tensor(mean), "log_std" if raw is None else "log_std_raw": tensor(log_std if raw is None else raw)}
        m, s = variables["mean"], list(variables.values())[1]
        inputs, outputs, ups = dict(variables), {}, []
        if raw is not None:
            s = -5 + 3.5 * (torch.tanh(s) + 1)
            outputs["log_std"] = s
        bound = 8 * U
        with torch.no_grad():
            ls, A = s.abs(), m.shape[1]
            relative = lambda err, result: float(err.max()) / max(1e-300, float(result.abs().max()))
            std = torch.exp(s)
        errors = []
        if actions is not None:
            a = torch.tensor(np.float32(actions).astype(np.float64))
            inputs["actions"], outputs["log_prob"] = a, gaussian_log_prob(m, s, a)
            u = torch.atanh(a)
            z = (u - m) / std
            ez = (2 * u.abs() + (u - m).abs()) * U / std + (4 + 2 * ls) * U * z.abs()
            terms = 0.5 * z**2 + ls + 1 - torch.log1p(-a * a)
            errors.append(((z.abs() * ez + (4 + A) * U * terms).sum(-1), outputs["log_prob"]))
            d_mean, d_log_std = (ez + (4 + ls) * U * z.abs()) / std, 2 * z.abs() * ez + 4 * U * (z**2 + 1)
        else:
            d_mean = d_log_std = torch.zeros_like(m)
        if noise is not None:
            n = torch.tensor(noise)
            inputs["noise"], outputs["entropy"] = n, gaussian_entropy(m, s, n)
            eu = U * (m.abs() + (3 + ls) * (std * n).abs())
            u = m + std * n
            errors.append(((2 * eu + (4 + A) * U * (n**2 + ls + 1 + 2 * u.abs())).sum(-1), outputs["entropy"]))
            d_mean = d_mean + 2 * eu + 4 * U
            d_log_std = d_log_std + (std * n).abs() * (2 * eu + (8 + ls) * U) + U
        ups = [paint(9 + i, *y.shape) for i, y in enumerate(outputs.values())]
        for key, up in zip(outputs, ups):
            inputs["upstream" + ("/" + key if len(outputs) > 1 else "")] = up
        g = gradients(list(outputs.values()), ups, variables)
        d_s = d_log_std
        if raw is not None:
            d_s = 3.5 * d_log_std + 20 * U * (1 + d_log_std / U * U)
        errors += [(d_mean, g["gradient/mean"]), (d_s, list(g.values())[1])]
        bound = max([bound] + [2 * relative(err, result) for err, result in errors if result.abs().max() > 0])
        outputs.update(g)
        # Acting.
        clamp = lambda x: torch.clamp(x, -1 + 1e-6, 1 - 1e-6)
        outputs["most_likely"] = clamp(torch.tanh(m))
        if noise is not None:
            outputs["sampled"] = clamp(torch.tanh(m + std * torch.tensor(noise)))
        f.case(name, note, f"float64 {max(1e-12, bound * 2**-28):.2g}, float32 {bound:.2g}: rounded at each operation, "
               "carried to first order through (u - m) / std and the squares", TORCH, inputs, outputs)

    m, s, n = paint(1, 4, 3), paint(30, 4, 3, scale=0.5), paint(60, 4, 3, scale=2.0)
    case("plain", "mean_over_action_dims: the sum over the action's dimensions; the sign of log|slope|", m, s, None,
         paint(20, 4, 3), n)
    edge = np.float32(1) - np.float32(1e-6)
    case("at_the_clamp", "atanh_unclamped: actions at +-(1 - 1e-6), where log(1 - a^2) loses digits", m[:2], s[:2], None,
         np.array([[edge, -edge, 0.0], [0.5, edge, -0.0]]))
    case("far_mean", "softplus_overflow: means of +-20 and more: log(1 - tanh^2) is -infinity when computed so",
         np.array([[20.0, -20.0, 60.0], [-88.0, 0.0, 100.0]]), np.zeros((2, 3)), None, None, n[:2])
    case("log_std_ends", "log-std at both ends of [-5, 2], the raw value far beyond", m[:2], None,
         np.array([[20.0, -20.0, 0.0], [100.0, -100.0, 0.5]]), paint(20, 2, 3), n[:2])
    case("log_std_squash", "-5 + 3.5 (tanh(x) + 1), not a clamp", m, None, paint(30, 4, 3), paint(20, 4, 3), n)
    case("one_dimension", "one action dimension", m[:, :1], s[:, :1], None, paint(20, 4, 1), n[:, :1])
    case("no_noise", "noise 0: the sample is tanh(mean), the entropy has no noise^2 / 2", m, s, None, None, np.zeros((4, 3)))
    data = np.array([[1.0, -1.0, 0.5], [3.0, -2.0, 0.0]], dtype=np.float32)
    top = float(np.float32(1) - np.float32(1e-6))
    f.case("data_actions", "actions of the data are clamped to +-(1 - 1e-6) before they are used", "exact: float32",
           CLOSED, {"mean": np.zeros((2, 3)), "log_std": np.zeros((2, 3)), "data_actions": data},
           {"clamped": np.clip(data.astype(np.float64), -top, top)})
    f.save()


def policy_discrete():
    f = File("policy_discrete", "WODTEM eq. (2), WODTEM eq. (3): log pi and H; WODTEM sec. III-B's categorical policy")

    def case(name, note, logits, actions, uniform=None, sampled=None):
        x = tensor(logits)
        n, moves = x.shape
        log_p = x - torch.logsumexp(x, -1, keepdim=True)
        entropy = -(torch.exp(log_p) * log_p).sum(-1)
        a = np.array(actions)
        outputs = {"log_probabilities": log_p, "entropy": entropy, "log_prob": log_p[np.arange(n), a]}
        ups = [paint(9 + i, *y.shape) for i, y in enumerate(outputs.values())]
        inputs = {"logits": x, "actions": a}
        inputs.update({"upstream/" + key: up for key, up in zip(outputs, ups)})
        spread = float((x.max(-1, keepdim=True).values - x).max())
        g = gradients(list(outputs.values()), ups, {"logits": x})
        bound = (4 * spread + 2 * moves + 16) * U
        scale = min(float(y.abs().max()) for y in list(outputs.values()) + list(g.values()))
        size = max(1.0, spread)
        outputs.update(g)
        outputs["most_likely"] = np.argmax(logits, -1)
        if uniform is not None:
            inputs["uniform"], outputs["sampled"] = np.array(uniform), np.array(sampled)
        f.case(name, note, f"float64 1e-12, float32 {bound * size / scale:.2g}: {4 * spread:.0f} (the logits' spread) + "
               f"{2 * moves} + 16 roundings", TORCH, inputs, outputs)

    case("plain", "log of the softmax; entropy in nats; the slope of H", paint(1, 4, 5, scale=4.0), [0, 4, 2, 3])
    case("equal_logits", "equal logits: H is log n; the most likely is the first; uniform just below and at a boundary",
         np.zeros((5, 4)), [0, 1, 2, 3, 0], [0.0, 0.25 - 2.0**-20, 0.25 + 2.0**-20, 0.75 + 2.0**-20, 1 - 2.0**-24],
         [0, 0, 1, 3, 3])
    case("gap_100", "a gap of 100: 0 log 0, and exp without the largest subtracted", np.array(
        [[0.0, -100.0, -200.0], [100.0, 0.0, 100.0], [-100.0, -100.0, 0.0]]), [1, 0, 2],
        [1 - 2.0**-24, 0.5 + 2.0**-20, 2.0**-24], [0, 2, 2])
    case("two_moves", "two moves", paint(7, 3, 2), [1, 0, 1])
    # The rule: the move whose share of [0, 1) contains the number. The last one takes what rounding leaves over.
    f.save()


def policy_deterministic():
    f = File("policy_deterministic", "DT sec. 3: the squared error")

    def case(name, note, raw, actions):
        x, a = tensor(raw), torch.tensor(actions)
        action = torch.tanh(x)
        outputs = {"action": action, "log_prob": -((action - a)**2).mean(-1)}
        ups = [paint(9 + i, *y.shape) for i, y in enumerate(outputs.values())]
        inputs = {"raw": x, "actions": a}
        inputs.update({"upstream/" + key: up for key, up in zip(outputs, ups)})
        g = gradients(list(outputs.values()), ups, {"raw": x})
        scale = min(float(y.abs().max()) for y in list(outputs.values()) + list(g.values()))
        f.case(name, note, f"float64 1e-12, float32 {16 * U * 4 / scale:.2g}: 16 roundings of numbers up to 4", TORCH, inputs,
               dict(outputs, **g))

    case("plain", "the mean over the action's dimensions, not the sum, not the root", paint(1, 4, 3), paint(20, 4, 3))
    case("saturated", "tanh at 1: no gradient, and none from the clamp that acting has", np.array([[20.0, -20.0], [0.5, 0.0]]),
         np.array([[1.0, 0.5], [-0.25, 0.0]]))
    f.save()


TOPICS = [rng, returns, linear, layernorm, mlp, attention, tokens, policy_gaussian, policy_discrete,
          policy_deterministic]

if __name__ == "__main__":
    for make in TOPICS:
        if len(sys.argv) == 1 or make.__name__ in sys.argv[1:]:
            make()
