#!/usr/bin/env python3
"""Where the golden vectors of this folder come from. Nothing runs this file: no build, no test, not `wodtem`.

It shares no code with the project: equations written again, in NumPy and PyTorch, in float64, in the plainest form that
each has, with gradients by PyTorch's autograd; the physics by MuJoCo's own library through a few lines of C. The files
were made on 2026-11-24, 2026-11-29 and 2026-12-01 by Debian 12's python3 3.11.2, python3-numpy 1.24.2, python3-torch
1.13.0a0 and libmujoco 2.2.2:

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
            self.metadata[name + "." + key] = str(text)
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
                if value.dtype == np.int64 and abs(value).max(initial=0) < 2**31:
                    value = value.astype(np.int32)
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


class Draw:
    """What is drawn by (seed, stream) of (step, index, site)."""

    def __init__(self, seed, stream):
        self.key = [seed, stream]

    def words(self, step, index, site=0):
        return philox([index, site, step & 0xFFFFFFFF, step >> 32], self.key)

    def uniform(self, step, index, site=0):
        w = self.words(step, index, site)
        return ((w[1] << 32 | w[0]) >> 11) / 2.0**53

    def normal(self, step, index, site=0):
        w = self.words(step, index, site)
        return math.sqrt(-2 * math.log(((w[2] >> 8) + 1) / 2.0**24)) * math.cos((w[3] >> 8) / 2.0**24 * 2 * math.pi)

    def below(self, bound, step, index, site=0):
        w = self.words(step, index, site)
        return (w[1] << 32 | w[0]) * bound >> 64

    def dropout(self, probability, step, site, element):
        """element: an array of whole numbers."""
        word = np.choose(element % 4, self.words(step, np.uint64(element // 4), site))
        return np.where(word < int(probability * 2**32), 0.0, 1 / (1 - probability))


NORMAL = 8 * 2 * math.pi * U  # of Draw.normal in float32: the angle, up to 2 pi, is rounded three times


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
    f.case(
        "uniform", "the counter is (index, site, step low, step high), the key (seed, stream); 53 bits of words 1 and "
        "0: swapped words, 32 bits alone, division by 2^64 - 1", "exact: multiples of 2^-53", CLOSED, draws,
        {"uniform": np.array([(x >> 11) / 2.0**53 for x in long])}, **setting)
    bounds = [1, 3, 10, 750, 4294967297, 3 * 2**61]
    f.case("below",
           "modulo_bias: the high half of the 128-bit product, not a remainder; bounds that are no power of two",
           "exact: whole numbers", CLOSED, dict(draws, bound=np.array(bounds, dtype=np.uint64)),
           {"below": np.array([x * b >> 64 for x, b in zip(long, bounds)], dtype=np.uint64)}, **setting)
    u, angle = [((w[2] >> 8) + 1) / 2.0**24 for w in words], [(w[3] >> 8) / 2.0**24 * 2 * math.pi for w in words]
    f.case("normal", "Box and Muller from words 2 and 3: the sine for the cosine, u = 0 (24 bits, plus one), degrees",
           f"float32 {8 * 2 * math.pi * U:.2g}: the angle, up to 2 pi, is rounded three times, and each function once",
           CLOSED, draws, {"normal": np.array([math.sqrt(-2 * math.log(a)) * math.cos(b) for a, b in zip(u, angle)])},
           **setting)
    probability, place, update = float(np.float32(0.1)), 7, 2**32 + 5
    bits = [w for i in range(25) for w in philox([i, place, update & ones, update >> 32], [seed, 2])]
    f.case("dropout",
           "one word for each element, not one counter; kept elements are scaled up",
           f"float32 {2 * U:.2g}: one quotient",
           CLOSED, {},
           {"dropout": np.array([0.0 if b < int(probability * 2**32) else 1 / (1 - probability) for b in bits[:98]])},
           seed=seed,
           stream=2,
           probability=repr(probability),
           place=place,
           update=update)
    f.save()


# ----------------------------------------------------------------------------------------------------------------------
# returns, from their definitions as sums, not by recursion.


def sums(rewards, gamma):
    return np.array([
        math.fsum(gamma**(j - t) * rewards[j] for j in range(t, len(rewards))) for t in range(len(rewards))])


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
        f.case(name,
               note,
               f"float64 1e-12, float32 {k * U * float(largest):.2g}: {k} roundings of the sum of |products|",
               TORCH, {"x": x, "weight": w, "bias": b, "upstream": up},
               dict({"y": y}, **g),
               layout=layout)

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
        f.case(name, note,
               f"float64 1e-12, float32 {k * U * float(max(sizes)):.2g}: {k} roundings of the sum of |products|", TORCH,
               {"x": x, "c_fc.weight": w1, "c_fc.bias": b1, "c_proj.weight": w2, "c_proj.bias": b2, "upstream": up},
               dict({"y": y}, **{"gradient/" + n: v
                                 for n, v in g.items()}))

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
    case("huge_logits",
         "logits beyond +-80: exp without the largest subtracted overflows in float32 and, at 800, in float64", 6, 4, 1,
         None, 64.0)
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


class Mask:
    """Dropout's factors, which count the elements of the packed computation: its rows are all tokens but each window's
    last action, in the last layer the state tokens alone. A row that it does not have is masked by 1."""

    def __init__(self, lengths, layers, heads, probability, update, seed, part=0):
        self.lengths, self.layers, self.heads = lengths, layers, heads
        self.probability, self.update, self.part = probability, update, part
        self.draw = Draw(seed, 2)

    def rows(self, window, site):
        """(token, row) of those that are computed."""
        C, before = self.lengths[window], self.lengths[:window]
        if site > 3 * (self.layers - 1):
            return [(3 * c + 1, sum(before) + c) for c in range(C)]
        return [(i, sum(3 * n - 1 for n in before) + i) for i in range(3 * C - 1)]

    def factor(self, site, element):
        return self.draw.dropout(self.probability, self.update, site + (self.part << 20), element)

    def of_tokens(self, window, site, d):
        mask = np.ones((3 * self.lengths[window], d))
        token, row = np.array(self.rows(window, site)).T
        mask[token] = self.factor(site, row[:, None] * d + np.arange(d))
        return torch.tensor(mask)

    def of_weights(self, window, site):
        tokens, longest = 3 * self.lengths[window], 3 * max(self.lengths) - 1
        mask = np.ones((self.heads, tokens, tokens))
        token, row = np.array(self.rows(window, site)).T
        head = np.arange(self.heads)[:, None, None]  # keys behind the token get a factor, too, and have the weight 0
        mask[:, token] = self.factor(site, (row[:, None] * self.heads + head) * longest + np.arange(tokens))
        return torch.tensor(mask)


def network(p, windows, heads, mask=None):
    """windows: (R [C], s [C, S], a [C, A], t [C]) each. Returns the outputs of all layers as a list of windows, and
    which of their rows a packed computation has: all tokens but the last action, or the state tokens alone."""
    layers = [name.split(".")[2] for name in p if name.endswith("attn.c_attn.weight")]
    outputs, every, asking = {}, [], []
    for window, (R, s, a, t) in enumerate(windows):
        C, d = len(R), p["embed_ln.weight"].shape[0]
        drop = lambda site, x: x if mask is None else x * mask.of_tokens(window, site, d)
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
        x = put("embed_ln", drop(0, layer_norm(x, p["embed_ln.weight"], p["embed_ln.bias"])))
        unseen = torch.full((3 * C, 3 * C), -math.inf).triu(1)
        for layer in layers:
            h, site = f"transformer.h.{layer}", 1 + 3 * int(layer)
            g = lambda name: (p[f"{h}.{name}.weight"], p[f"{h}.{name}.bias"])
            w, b = g("attn.c_attn")
            q, k, v = (layer_norm(x, *g("ln_1")) @ w + b).split(d, 1)
            cut = lambda z: z.reshape(3 * C, heads, d // heads).transpose(0, 1)
            weights = torch.softmax(cut(q) @ cut(k).transpose(1, 2) / math.sqrt(d // heads) + unseen, -1)
            if mask is not None:
                weights = weights * mask.of_weights(window, site)
            y = (weights @ cut(v)).transpose(0, 1).reshape(3 * C, d)
            w, b = g("attn.c_proj")
            x = put(h + ".attn", x + drop(site + 1, y @ w + b))
            w, b = g("mlp.c_fc")
            hidden = torch.relu(layer_norm(x, *g("ln_2")) @ w + b)
            w, b = g("mlp.c_proj")
            x = put(h, x + drop(site + 2, hidden @ w + b))
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


def start_values(seed, state_dim, action_dim, layers, d, head, positions=0):
    draw, p = Draw(seed, 1), {}
    for number, (key, shape) in enumerate(parameter_shapes(state_dim, action_dim, layers, d, head,
                                                           positions).items()):
        kind, n = key.rsplit(".", 1)[1], int(np.prod(shape))
        normal = lambda: np.array([draw.normal(number, i) for i in range(n)]).reshape(shape)
        orthogonal = "predict_action" in key and head != "deterministic"
        if "ln_" in key or "embed_ln" in key:
            p[key] = np.full(shape, 1.0 if kind == "weight" else 0.0)
        elif key == "embed_ordering.weight":
            p[key] = normal()
        elif key.startswith("transformer."):
            p[key] = 0.02 * normal() if kind == "weight" else np.zeros(shape)
        elif orthogonal:
            p[key] = np.zeros(shape)
            for i, row in enumerate(normal() if kind == "weight" else ()):
                for other in p[key][:i]:
                    row = row - (row @ other) * other
                p[key][i] = row / np.sqrt(row @ row)
        else:
            fan_in = {"embed_return": 1, "embed_state": state_dim, "embed_action": action_dim}.get(
                key.split(".")[0], d)
            p[key] = np.array([(2 * draw.uniform(number, i) - 1) / math.sqrt(fan_in) for i in range(n)
                              ]).reshape(shape)
    return p


def start_projection(seed, projected_dim, state_dim):
    return np.array([Draw(seed, 8).normal(0, i) / math.sqrt(projected_dim) for i in range(projected_dim * state_dim)
                    ]).reshape(projected_dim, state_dim)


def initialisation():
    f = File("initialisation", "none: ODT's start values, from the seed")

    def case(name, note, seed, state_dim, action_dim, layers, d, head, positions=0, projected_dim=0):
        p = start_values(seed, state_dim, action_dim, layers, d, head, positions)
        outputs = {"parameter/" + key: value for key, value in p.items()}
        settings = {"seed": seed, "state_dim": state_dim, "action_dim": action_dim, "layers": layers, "width": d,
                    "head": head, "positions": positions}
        if projected_dim:
            outputs["projection"] = start_projection(seed, projected_dim, state_dim)
            settings["projected_dim"] = projected_dim
        f.case(name, note, f"float32 {NORMAL:.2g}: normals as in rng, uniform numbers are rounded once",
               NUMPY + ", Python's whole numbers", {}, outputs, **settings)
        for key in p:
            if "predict_action" in key and key.endswith("weight") and head != "deterministic":
                f.tolerance(name, "parameter/" + key, f"float32 {8 * NORMAL:.2g}: differences of rows of normals")

    case("gaussian", "which distribution for which tensor; a tensor's number is its place in this order, the biases "
         "count; orthonormal heads, by Gram and Schmidt; the memory's projection has variance 1 / F1",
         7, 3, 2, 2, 8, "gaussian", projected_dim=4)
    case("categorical", "positions come last, so that they move no other tensor's numbers", 4294967295, 2, 5, 1, 6,
         "categorical", 3)
    case("deterministic", "DT's head is an ordinary Linear: uniform, not orthonormal", 0, 3, 2, 1, 4, "deterministic")
    f.save()


def tokens():
    f = File("tokens", "WODTEM sec. III-A: s_{-C,t}, g_{-C,t}; DT sec. 3: the order R, s, a")

    def case(name,
             note,
             lengths,
             positions=0,
             timesteps=None,
             last_action=None,
             held=("embed", "embed_ln"),
             head="gaussian",
             state_dim=3,
             action_dim=2,
             d=4,
             layers=1,
             dropout=None):
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
        settings = {} if dropout is None else dict(dropout, dropout=repr(float(np.float32(dropout["dropout"]))))
        mask = None if dropout is None else Mask(lengths, layers, 2, float(settings["dropout"]), dropout["update"],
                                                 dropout["seed"], dropout["part"])
        outputs, rows = network(p, split_windows(lengths, R, s, a, t), 2, mask)
        results = {"layer/" + name: packed(outputs[name], rows[name]) for name in held}
        k = 8 * (max(state_dim, action_dim) + d + 8) * (1 + 8 * layers * (len(held) > 2))
        f.case(name,
               note,
               f"float64 1e-11, float32 {k * U:.2g}: {k} roundings, those of sums and those a LayerNorm enlarges",
               TORCH,
               inputs,
               results,
               heads=2,
               **settings)

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
    case("one_hot", "a discrete action is a token one-hot", [3, 1], 0, None, None, ("embed", "policy.mean"),
         "categorical", 2, 4)
    case("deterministic", "DT's head: tanh of predict_action.0, positions in use", [2, 2], 5, None, None,
         ("embed", "policy.mean"), "deterministic")
    case("dropout", "dropout's places and how elements are counted: after embed_ln, then in each layer the attention's "
         "weights, its projection, the MLP; not before embed_ln, not after ln_f", [2, 1, 3], 0, None, None,
         ("embed", "embed_ln", "transformer.h.0.attn", "transformer.h.0", "transformer.h.1.attn", "transformer.h.1",
          "transformer.ln_f", "policy.mean", "policy.log_std"), layers=2,
         dropout={"dropout": 0.25, "seed": 11, "update": 2**32 + 3, "part": 5})
    f.save()


# ----------------------------------------------------------------------------------------------------------------------
# acting: an episode step by step, each window through the network by itself.


def acting():
    f = File("acting", "WODTEM sec. III-B: acting, its return-to-go and its sliding context")

    def case(name, note, head, act, T, eval_context, context_length, state_dim=3, action_dim=2, layers=1, d=8,
             positions=0, target=3.0, scale=0.5, seed=5, episode=0, bias=None):
        p = painted_parameters(parameter_shapes(state_dim, action_dim, layers, d, head, positions))
        if bias is not None:
            p["predict_action.mu.bias"] = torch.tensor(bias)
        states, rewards = paint(1, T, state_dim, scale=4.0), paint(11, T, scale=2.0)
        mean, deviation = paint(40, state_dim), 2.0**(np.arange(state_dim) - 1)
        chance, context = Draw(seed, 4), min(eval_context, context_length)
        told, taken, tokens = [np.float64(target * scale)], [], np.zeros((T, action_dim))
        window = {"lengths": [], "timesteps": [], "returns_to_go": [], "states": [], "actions": []}
        policies, drawn = [], []
        normalised = (states - mean) / deviation
        for t in range(T):
            first = max(0, t + 1 - context)
            steps = np.arange(first, t + 1)
            window["lengths"].append(len(steps))
            window["timesteps"] += list(steps)
            window["returns_to_go"] += [told[i] for i in steps]
            window["states"] += list(normalised[steps])
            window["actions"] += list(tokens[steps[:-1]])
            batch = (torch.tensor(np.array(told)[steps]), torch.tensor(normalised[steps]), torch.tensor(tokens[steps]),
                     steps)
            outputs, _ = network(p, [batch], 2)
            last = lambda name: outputs[name][0][-1].detach().numpy()
            policies.append([last(x) for x in ("policy.mean", "policy.log_std") if x in outputs])
            if head == "categorical":
                probability = np.exp(last("policy.mean"))
                if act == "most_likely":
                    move = int(np.argmax(probability))
                    assert np.sort(probability)[-1] - np.sort(probability)[-2] > 1e-3
                else:
                    drawn.append(chance.uniform(episode, t))
                    ends = np.cumsum(probability)
                    move = int(np.searchsorted(ends, drawn[-1], side="right"))
                    assert abs(ends[:-1] - drawn[-1]).min() > 1e-3
                taken.append(move)
                tokens[t, move] = 1
            else:
                u = last("policy.mean")
                if head == "gaussian" and act == "sample":
                    drawn.append([chance.normal(episode, t, i) for i in range(action_dim)])
                    u = u + np.exp(last("policy.log_std")) * drawn[-1]
                a = np.tanh(u) if head == "gaussian" else u  # DT's is squashed by the network
                taken.append(np.clip(a, -1 + 1e-6, 1 - 1e-6))
                tokens[t] = taken[-1]
            told.append(told[-1] - rewards[t] * scale)
        chain = 2 + state_dim + layers * (2 * (d + 8) + 4 * d + d // 2 + 3 * context) + d
        k = 2 * math.ceil(8 * math.sqrt(chain))
        inputs = {"parameter/" + key: v for key, v in p.items()}
        inputs.update({"states": states, "rewards": rewards, "state_mean": mean, "state_deviation": deviation})
        outputs = {"window/" + key: np.array(v, dtype=np.int64 if key in ("lengths", "timesteps") else np.float64)
                   for key, v in window.items()}
        outputs["window/actions"] = outputs["window/actions"].reshape(-1, action_dim)
        outputs["returns_to_go"] = np.array(told)
        for i, key in enumerate(["log_probabilities"] if head == "categorical" else ["mean", "log_std"]):
            if i < len(policies[0]) and head != "deterministic":
                outputs[key] = np.array([policy[i] for policy in policies])
        if drawn:
            outputs["uniform" if head == "categorical" else "noise"] = np.array(drawn)
        outputs["action"] = np.array(taken)
        settings = {"heads": 2, "act": act, "target": target, "reward_scale": scale, "eval_context": eval_context,
                    "context_length": context_length}
        if act == "sample":
            settings.update(seed=seed, episode=episode)
        f.case(name, note, f"float32 {k * U:.2g}: 16 roots of {chain} roundings, as earlier actions are off too",
               TORCH, inputs, outputs, **settings)
        f.tolerance(name, "returns_to_go", "exact: halves of 128ths")
        f.tolerance(name, "window/returns_to_go", "exact: halves of 128ths")
        if act == "sample":
            f.tolerance(name, list(outputs)[-2], f"float32 {NORMAL:.2g}: as in rng")
        if bias is not None:
            f.tolerance(name, "action", f"float32 {U:.2g}: the clamp's two ends")

    case("gaussian_most_likely",
         "the window slides: the latest eval_context steps, the present one last; time-steps count from the episode's "
         "first and are clipped at the table's end; tanh(mean), no noise", "gaussian", "most_likely", 8, 3, 4,
         layers=2, positions=6)
    case("gaussian_sampled",
         "never more than context_length steps; R_1 is target times scale, and falls by reward times scale; stream 4: "
         "step is the episode, index the time-step, site the dimension", "gaussian", "sample", 6, 5, 2,
         target=-1.5, scale=0.25, episode=2**40 + 3)
    case("first_action", "the first action sees R_1 and s_1 alone, whatever eval_context", "gaussian", "sample", 1, 20,
         20)
    case("whole_context", "an episode shorter than the context: nothing is padded", "gaussian", "most_likely", 4, 20,
         20)
    case("clamped", "actions are clamped to +-(1 - 1e-6) before they are taken, and so before they are tokens",
         "gaussian", "most_likely", 3, 3, 3, bias=[30.0, -30.0])
    case("categorical_most_likely", "moves enter as one-hot tokens", "categorical", "most_likely", 7, 3, 20,
         state_dim=2, action_dim=4)
    case("categorical_sampled", "the move whose share of [0, 1) contains the number: one number a step, of site 0",
         "categorical", "sample", 7, 2, 20, state_dim=2, action_dim=4, episode=9)
    case("deterministic", "DT: the network's own tanh, clamped; nothing is drawn", "deterministic", "most_likely", 5, 2,
         4, positions=4)
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
        variables = {
            "mean": tensor(mean), "log_std" if raw is None else "log_std_raw": tensor(log_std if raw is None else raw)}
        m, s = variables["mean"], list(variables.values())[1]
        inputs, outputs, ups = dict(variables), {}, []
        if raw is not None:
            s = -5 + 3.5 * (torch.tanh(s) + 1)
            outputs["log_std"] = s
        with torch.no_grad():
            ls, A = s.abs(), m.shape[1]
            relative = lambda err, result: float(err.max()) / max(1e-300, float(result.abs().max()))
            std = torch.exp(s)
        errors = {}
        if actions is not None:
            a = torch.tensor(np.float32(actions).astype(np.float64))
            inputs["actions"], outputs["log_prob"] = a, gaussian_log_prob(m, s, a)
            u = torch.atanh(a)
            z = (u - m) / std
            ez = (2 * u.abs() + (u - m).abs()) * U / std + (4 + 2 * ls) * U * z.abs()
            terms = 0.5 * z**2 + ls + 1 - torch.log1p(-a * a)
            errors["log_prob"] = (z.abs() * ez + (4 + A) * U * terms).sum(-1)
            d_mean, d_log_std = (ez + (4 + ls) * U * z.abs()) / std, 2 * z.abs() * ez + 4 * U * (z**2 + 1)
        else:
            d_mean = d_log_std = torch.zeros_like(m)
        if noise is not None:
            n = torch.tensor(noise)
            inputs["noise"], outputs["entropy"] = n, gaussian_entropy(m, s, n)
            eu = U * (m.abs() + (3 + ls) * (std * n).abs())
            u = m + std * n
            errors["entropy"] = (2 * eu + (4 + A) * U * (n**2 + ls + 1 + 2 * u.abs())).sum(-1)
            errors["sampled"] = eu + 4 * U
            d_mean = d_mean + 2 * eu + 4 * U
            d_log_std = d_log_std + (std * n).abs() * (2 * eu + (8 + ls) * U) + U
        ups = [paint(9 + i, *y.shape) for i, y in enumerate(outputs.values())]
        for key, up in zip(outputs, ups):
            inputs["upstream" + ("/" + key if len(outputs) > 1 else "")] = up
        g = gradients(list(outputs.values()), ups, variables)
        d_s = d_log_std
        if raw is not None:
            d_s = 3.5 * d_log_std + 20 * U * (1 + d_log_std / U * U)
        errors.update({"gradient/mean": d_mean, list(g)[1]: d_s})
        outputs.update(g)
        # Acting.
        clamp = lambda x: torch.clamp(x, -1 + 1e-6, 1 - 1e-6)
        outputs["most_likely"] = clamp(torch.tanh(m))
        if noise is not None:
            outputs["sampled"] = clamp(torch.tanh(m + std * torch.tensor(noise)))
        f.case(name, note, f"float64 1e-12, float32 {8 * U:.2g}: a few roundings", TORCH, inputs, outputs)
        for key, err in errors.items():
            bound = 2 * relative(err, outputs[key]) if outputs[key].abs().max() > 0 else 0.0
            f.tolerance(
                name, key, f"float64 {max(1e-12, bound * 2**-28):.2g}, float32 {bound:.2g}: rounded at each operation, "
                "carried to first order through (u - m) / std and the squares")

    m, s, n = paint(1, 4, 3), paint(30, 4, 3, scale=0.5), paint(60, 4, 3, scale=2.0)
    case("plain", "mean_over_action_dims: the sum over the action's dimensions; the sign of log|slope|", m, s, None,
         paint(20, 4, 3), n)
    edge = np.float32(1) - np.float32(1e-6)
    case("at_the_clamp", "atanh_unclamped: actions at +-(1 - 1e-6), where log(1 - a^2) loses digits", m[:2], s[:2],
         None, np.array([[edge, -edge, 0.0], [0.5, edge, -0.0]]))
    case("far_mean", "softplus_overflow: means of +-20 and more: log(1 - tanh^2) is -infinity when computed so",
         np.array([[20.0, -20.0, 60.0], [-88.0, 0.0, 100.0]]), np.zeros((2, 3)), None, None, n[:2])
    case("log_std_ends", "log-std at both ends of [-5, 2], the raw value far beyond", m[:2], None,
         np.array([[20.0, -20.0, 0.0], [100.0, -100.0, 0.5]]), paint(20, 2, 3), n[:2])
    case("log_std_squash", "-5 + 3.5 (tanh(x) + 1), not a clamp", m, None, paint(30, 4, 3), paint(20, 4, 3), n)
    case("one_dimension", "one action dimension", m[:, :1], s[:, :1], None, paint(20, 4, 1), n[:, :1])
    case("no_noise", "noise 0: the sample is tanh(mean), the entropy has no noise^2 / 2", m, s, None, None,
         np.zeros((4, 3)))
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
        f.case(
            name, note, f"float64 1e-12, float32 {bound * size / scale:.2g}: {4 * spread:.0f} (the logits' spread) + "
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
        f.case(name, note, f"float64 1e-12, float32 {16 * U * 4 / scale:.2g}: 16 roundings of numbers up to 4", TORCH,
               inputs, dict(outputs, **g))

    case("plain", "the mean over the action's dimensions, not the sum, not the root", paint(1, 4, 3), paint(20, 4, 3))
    case("saturated", "tanh at 1: no gradient, and none from the clamp that acting has",
         np.array([[20.0, -20.0], [0.5, 0.0]]), np.array([[1.0, 0.5], [-0.25, 0.0]]))
    f.save()


# ----------------------------------------------------------------------------------------------------------------------
# The memory: a list of entries in order of insertion; a linear scan; nothing clever.


class Table:
    def __init__(self, capacity, K=1, epsilon=math.inf, eviction="lfu", projection=None, exclude_self=False):
        self.capacity, self.K, self.epsilon, self.eviction = capacity, K, epsilon, eviction
        self.projection, self.exclude_self = projection, exclude_self
        self.entries, self.clock, self.changes = [], 0, [0, 0, 0, 0]

    def touch(self, entry):
        self.clock += 1
        entry["accesses"] = entry["accesses"] + 1 if self.eviction == "lfu" else self.clock

    def find(self, state):  # -0.0 == 0.0 in Python too
        return next((e for e in self.entries if np.array_equal(e["state"], state)), None)

    def update(self, row, state, action, d):
        entry = self.find(state)
        if entry is None:
            if len(self.entries) == self.capacity:
                self.entries.remove(min(self.entries, key=lambda e: e["accesses"]))  # ties: the oldest
                self.changes[3] += 1
            entry = {"row": row, "state": state, "action": action, "e": d, "accesses": 0}
            self.entries.append(entry)
            self.changes[0] += 1
        elif entry["e"] < d:
            entry["action"], entry["e"] = action, d
            self.changes[1] += 1
        else:
            self.changes[2] += 1
        self.touch(entry)

    def place(self, state):
        return state if self.projection is None else np.float32(self.projection @ state).astype(np.float64)

    def nearest(self, query):
        q, own = self.place(query), self.find(query) if self.exclude_self else None
        found = [(float(((self.place(e["state"]) - q)**2).sum()), e) for e in self.entries if e is not own]
        found = [pair for pair in found if pair[0] < self.epsilon]
        return sorted(found, key=lambda pair: pair[0])[:self.K]  # stable: ties, the older first

    def e_hat(self, found):
        weights = [math.exp(found[0][0] - distance) for distance, _ in found]  # exp(-q) over the largest of them
        return sum(w * e["e"] for w, (_, e) in zip(weights, found)) / sum(weights) if found else math.nan


def memory_update():
    f = File("memory_update", "WODTEM eq. (4); WODTEM sec. IV-B.1: the least frequently accessed entry goes")

    def case(name, note, states, d, actions=None, looks_up=None, **settings):
        states, d = np.array(states, dtype=np.float64), np.array(d, dtype=np.float64)
        n = len(states)
        actions = paint(1, n, 2) if actions is None else np.array(actions)
        table = Table(settings.get("capacity", n), settings.get("K", 1), settings.get("epsilon", math.inf),
                      settings.get("eviction", "lfu"))
        inputs = {"states": states, "actions": actions, "e": d}
        if looks_up is not None:
            inputs["looks_up"] = np.array(looks_up)
        for row in range(n):
            if looks_up is not None and looks_up[row]:
                for _, entry in table.nearest(states[row]):
                    table.touch(entry)
            else:
                table.update(row, states[row], actions[row], d[row])
        there = [table.find(s) for s in states]
        nothing = {"e": math.nan, "action": np.full(2, math.nan), "accesses": 0}
        f.case(name, note, "exact: numbers are kept, never computed", NUMPY + ", a list and a linear scan", inputs,
               {"stored": np.array([e is not None for e in there], dtype=np.int64),
                "e": np.array([(e or nothing)["e"] for e in there]),
                "actions": np.array([(e or nothing)["action"] for e in there]),
                "accesses": np.array([(e or nothing)["accesses"] for e in there]),
                "size": np.array(len(table.entries)), "changes": np.array(table.changes)}, **settings)

    a, b, c, d4 = [0.5, 1.0], [0.5, 1.25], [-0.5, 1.0], [3.0, 0.0]
    case("new_states", "a state that is not stored is, with its action and its return, also when that is negative",
         [a, b, c], [-1.0, 2.0, 0.0])
    case("keeps_highest", "keeps_latest: of several returns the highest stays, with its action", [a, b, a, b, a],
         [1.0, 5.0, 3.0, 4.0, 2.0])
    case("equal_replaces", "equal_replaces: at e = d the older action stays", [a, a], [1.5, 1.5])
    case("one_ulp", "e < d by one ulp of double", [a, a, b, b],
         [1.0, np.nextafter(1.0, 2.0), 1.0, np.nextafter(1.0, 0.0)])
    case("twice_in_one_trajectory", "the same state twice in one trajectory, in order of time", [a, b, a, c],
         [2.5, 2.0, 1.5, 1.0])
    case("minus_zero", "-0.0 and 0.0 are one state", [[0.0, -0.0], [-0.0, 0.0], [0.0, 0.0]], [1.0, 2.0, 3.0])
    case("one_bit", "states that differ in the last bit are two: no rounding, no tolerance, no projection",
         [[1.0, 0.0], [float(np.nextafter(np.float32(1), np.float32(2))), 0.0]], [1.0, 2.0])
    case("full_table",
         "a full table gives up the least frequently accessed entry: a was met three times, b twice, c once",
         [a, b, c, a, a, b, d4], [1, 1, 1, 0, 0, 0, 1],
         capacity=3)
    case("eviction_tie",
         "least-used tie: of equal counts the oldest goes; the new entry itself does not", [a, b, c, d4],
         [4.0, 3.0, 2.0, 1.0],
         capacity=3)
    case("evict_lowest_return", "it is not the lowest return that goes", [a, b, a, c], [1.0, 9.0, 0.5, 5.0], capacity=2)
    case("update_counts",
         "an update that changes nothing is an access too", [a, b, b, b, c], [1, 1, 0, 0, 1],
         capacity=2)
    case("look_up_counts", "a neighbour within epsilon is accessed by a look-up, one beyond is not",
         [a, b, c, b, b, d4], [1, 1, 1, 0, 0, 1], looks_up=[0, 0, 0, 1, 1, 0], capacity=3, K=3, epsilon=0.25)
    case("lru", "least recently used, for comparison: a was met often, but long ago", [a, a, a, b, c, d4],
         [1, 1, 1, 1, 1, 1], capacity=3, eviction="lru")
    case("returns_after_eviction", "a state that comes back is new: its old return is forgotten", [a, b, c, a],
         [9.0, 1.0, 1.0, 2.0], capacity=2)
    f.save()


def memory_inputs(states, e, query, actions=None, projection=None):
    inputs = {"states": np.array(states, dtype=np.float64), "e": np.array(e, dtype=np.float64),
              "query": np.array(query, dtype=np.float64)}
    if actions is not None:
        inputs["actions"] = np.array(actions, dtype=np.float64)
    if projection is not None:
        inputs["projection"] = np.array(projection)
    return inputs


def filled(inputs, **settings):
    states = inputs["states"]
    table = Table(settings.get("capacity", max(1, len(states))), settings.get("K", 1),
                  settings.get("epsilon", math.inf), "lfu", inputs.get("projection"),
                  settings.get("exclude_self", 0) == 1)
    actions = inputs.get("actions", np.zeros((len(states), 1)))
    for row in range(len(states)):
        table.update(row, states[row], actions[row], inputs["e"][row])
    return table


def memory_lookup():
    f = File("memory_lookup", "WODTEM sec. IV-B.2: K(s_q); WODTEM eq. (5)")

    def case(name, note, states, e, query, projection=None, **settings):
        inputs = memory_inputs(states, e, query, None, projection)
        table = filled(inputs, **settings)
        found = [table.nearest(q) for q in inputs["query"]]
        K, m = settings.get("K", 1), len(found)
        neighbours, distances = np.full((m, K), -1), np.full((m, K), math.inf)
        for i, row in enumerate(found):
            for k, (distance, entry) in enumerate(row):
                neighbours[i, k], distances[i, k] = entry["row"], distance
        near = max([d for row in found for d, _ in row], default=0.0)
        S = inputs["states"].shape[1]
        f.case(
            name, note,
            f"float32 {(2 * (S + 4) * near + 8) * U:.2g}: distances and exp are float32: a distance of up to "
            f"{near:.3g} takes {S} + 4 roundings; sums are double", NUMPY + ", a linear scan", inputs, {
                "neighbours": neighbours, "count": np.array([len(row) for row in found]), "distances": distances,
                "e_hat": np.array([table.e_hat(row) for row in found])}, **settings)

    a, b, c = [0.0, 0.0], [0.5, 0.0], [0.0, 1.0]
    grid = [a, b, c, [1.0, 1.0], [-0.5, 0.25]]
    e = [10.0, 20.0, -5.0, 3.0, 0.5]
    case("weighted_mean", "unweighted_mean: e-hat weighs by exp(-q)", grid, e, [[0.25, 0.25], [0.0, 0.5]], K=3)
    case("root_taken",
         "root_taken: q is the squared distance; the nearest two lie at 1/4 and 1",
         grid,
         e, [b, [0.0, 2.0]],
         K=2)
    case("empty_table", "an empty table: no neighbour, e-hat unknown", np.zeros((0, 2)), [], [a], K=2, epsilon=1.0)
    case("one_entry", "one entry: e-hat is its e, whatever the distance", [a], [7.25], [[3.0, 4.0], a], K=2)
    case("K_beyond_entries", "K larger than the table", grid, e, [[0.25, 0.5]], K=9)
    below, above = np.nextafter(np.float32(0.5), np.float32([0, 1])).astype(np.float64)
    case("epsilon_reached", "epsilon is strict: q just below, at, just above 1/4", [a], [4.0],
         [[below, 0.0], [0.5, 0.0], [above, 0.0]], K=1, epsilon=0.25)
    case("epsilon_before_K", "the K nearest, of those within epsilon: none that lies beyond fills up K", grid, e,
         [[0.125, 0.0]], K=4, epsilon=0.2)
    case("ties_older_first",
         "tie: of equal distances the older entry is the nearer one", [b, [-0.5, 0.0], [0.0, 0.5], a],
         e[:4], [a],
         K=3)
    case("ties_cut", "tie at the K-th place: the older entry stays", [[0.0, 0.5], b, [-0.5, 0.0], [0.0, -0.5]],
         [1.0, 2.0, 3.0, 4.0], [a], K=2)
    # All signs and orders of four numbers lie equally far from 0. Of 72 states, shuffled, 18 are near and 54 far. The
    # first 40 fill the table; some are met again; then the others take the places of those that were not.
    sign = lambda i: [1 - 2 * (i >> j & 1) for j in range(4)]
    orders = lambda values, n: [list(np.roll(values, i % 4) * sign(i // 4)) for i in range(n)]
    states = orders([0.5, 0.25, 0.125, 0.375], 18) + orders([1.0, 0.5, 0.25, 0.75], 54)
    states = [states[i * 31 % 72] for i in range(72)]
    assert len({tuple(s) for s in states}) == 72
    rows = states[:40] + [states[i] for i in range(0, 40, 3)] + states[40:]
    case("ties_many", "an unstable sort: of up to 54 equal distances the older entries come first, whatever their "
         "places in the table", rows, paint(61, len(rows), scale=4.0), [[0.0] * 4, [0.0, 0.0, 0.0, 2.0]], K=20,
         capacity=40)
    case("exact_hit",
         "an exact hit is a neighbour at distance 0 beside others, not the answer alone",
         grid,
         e, [c],
         K=2)
    case("exclude_self", "the option that leaves the query's own entry out", grid, e, [c, [0.25, 0.25]], K=2,
         exclude_self=1)
    case("minus_zero", "-0.0 lies at distance 0 from 0.0, and is its own entry", grid, e, [[-0.0, -0.0]], K=1,
         exclude_self=1)
    case("far",
         "exp(-q) underflows, 0 / 0: at q = 900 and 961 e-hat is still the nearer one's", [[0.0, 0.0], [61.0, 0.0]],
         [2.0, 8.0], [[30.0, 0.0], [30.5, 0.0]],
         K=2)
    many = paint(5, 200, 3)
    case("many", "200 entries, five numbers of neighbours at once: what a tree must find", many, paint(90, 200) * 16,
         paint(44, 12, 3) + 2.0**-9, K=5, epsilon=0.05)
    states = paint(3, 6, 8)
    projection = paint(21, 4, 8)
    case("projected", "distances are those of the projected states, projection [F1, F] times a state", states,
         paint(7, 6) * 4, paint(13, 3, 8), projection, K=3, epsilon=8.0)
    case("projected_ties",
         "states that project to the same point are two entries at one distance", [[1.0, 2.0], [1.0, 5.0]], [1.0, 3.0],
         [[1.0, 7.0]],
         np.array([[1.0, 0.0]]),
         K=2)
    for name, query in (("nan_query", math.nan), ("infinite_query", math.inf)):
        f.case(name, "a state that is no number is an error, not a miss", "exact: an error", CLOSED,
               memory_inputs([a, b], e[:2], [[query, 0.0]]), {}, result="memory.not_finite")
    case("repeated_state", "the same state twice in the table's history is one entry, with the higher e", [a, b, a],
         [1.0, 2.0, 6.0], [a], K=3)
    f.save()


def memory_action():
    f = File("memory_action", "WODTEM eq. (6)")

    def case(name, note, states, e, query, uniform, rows, actions=None, **settings):
        """rows: which entry's action each query draws; checked below against the cumulative probabilities."""
        actions = paint(31, len(states), 2) if actions is None else np.array(actions)
        inputs = memory_inputs(states, e, query, actions)
        table, tau = filled(inputs, **settings), settings.get("tau", 1.0)
        for q, u, row in zip(inputs["query"], uniform, rows):
            found = [entry for _, entry in table.nearest(q)]  # closest first
            best = max(entry["e"] for entry in found)
            odds = [math.exp((entry["e"] - best) / tau) for entry in found]
            ends = np.cumsum(odds) / sum(odds)
            chosen = int(np.searchsorted(ends, u, side="right"))
            assert found[min(chosen, len(found) - 1)]["row"] == row, (name, u, ends, [x["row"] for x in found])
        f.case(name, note, "exact: an action is chosen, not computed", CLOSED, dict(inputs, uniform=np.array(uniform)),
               {"action": actions[rows]}, **settings)

    line = [[0.0], [0.25], [0.5]]
    near = [[0.0]]
    case("equal_returns", "equal e: a third each, the closest first; uniform 0 and 1 - 2^-24", line, [5.0, 5.0, 5.0],
         near * 6, [0.0, 1 / 3 - 1e-6, 1 / 3 + 1e-6, 2 / 3 - 1e-6, 2 / 3 + 1e-6, 1 - 2.0**-24], [0, 0, 1, 1, 2, 2], K=3)
    p = math.exp(-1) / (1 + math.exp(-1) + math.exp(-2))
    case("softmax_of_returns",
         "weights_by_distance: the odds are exp(e), whatever the distance; not proportional to e",
         line, [1.0, 2.0, 3.0],
         near * 4, [
             p * math.exp(-1) - 1e-6, p * math.exp(-1) + 1e-6, p * (1 + math.exp(-1)) - 1e-6, p *
             (1 + math.exp(-1)) + 1e-6], [0, 1, 1, 2],
         K=3)
    case("exp_overflow",
         "exp_overflow: e of 0, 300 and 3000: the largest is subtracted first",
         line, [0.0, 3000.0, 300.0],
         near * 3, [0.0, 0.5, 1 - 2.0**-24], [1, 1, 1],
         K=3)
    case("negative_returns", "e of -1000: exp underflows for all of them", line, [-1000.0, -1000.0, -1001.0], near * 2,
         [0.0, 1 - 2.0**-24], [0, 2], K=3)
    case("one_neighbour",
         "one neighbour: its action, whatever the number", [[0.5]], [2.0],
         near * 2, [0.0, 1 - 2.0**-24], [0, 0],
         K=2)
    case("only_neighbours",
         "an entry beyond epsilon is never drawn, however large its e",
         line, [1.0, 1.0, 99.0],
         near * 2, [0.25, 1 - 2.0**-24], [0, 1],
         K=3,
         epsilon=0.25)
    case("order_of_distance",
         "the shares lie in order of distance, not of age", [[0.5], [0.25], [0.0]], [1.0, 1.0, 1.0],
         near * 3, [0.1, 0.5, 0.9], [2, 1, 0],
         K=3)
    f.case("no_neighbour",
           "without a neighbour there is no action to remember: whoever asks makes an error",
           "exact: an error",
           CLOSED,
           dict(memory_inputs(line, [1.0] * 3, [[9.0]]), uniform=np.array([0.5])), {},
           epsilon=0.25,
           result="memory.no_neighbours")
    case("temperature", "tau divides e", line, [0.0, 10.0, 20.0], near * 2, [0.05, 0.2], [0, 1], K=3, tau=10.0)
    f.save()


def weights():
    f = File("weights", "WODTEM eq. (7)")

    def case(name, note, states, e, query, d, alpha, short=None, **settings):
        inputs = memory_inputs(states, e, query)
        table = filled(inputs, **settings)
        found = [table.nearest(q) for q in inputs["query"]]
        e_hat = [table.e_hat(row) for row in found]
        if short is None:
            short = [not math.isnan(h) and x < h for x, h in zip(d, e_hat)]
        near = max([q for row in found for q, _ in row], default=0.0)
        f.case(name, note, f"float32 {(2 * (inputs['states'].shape[1] + 4) * near + 8) * U:.2g}: as in memory_lookup",
               CLOSED, dict(inputs, d=np.array(d, dtype=np.float64)),
               {"w": np.where(short, alpha, 1.0), "e_hat": np.array(e_hat)}, alpha=alpha, **settings)
        f.tolerance(name, "w", "exact: 1 or alpha")

    a, b = [0.0], [0.5]
    up, down = np.nextafter(3.0, 4.0), np.nextafter(3.0, 2.0)
    case("comparison_strict", "comparison_strict: d = e-hat is optimal; one ulp below is not, one above is", [a], [3.0],
         [a] * 3, [3.0, down, up], 0.75)
    case("alpha_on_wrong_side",
         "alpha_on_wrong_side: what falls short gets alpha, what does not gets 1", [a, b], [1.0, 5.0], [a, a, b, b],
         [0.5, 4.0, 6.0, 2.0],
         0.9,
         K=2)
    case("no_neighbour",
         "no neighbour: w = 1, nothing speaks against the action; nor does an empty table", [a], [100.0], [[2.0], a],
         [0.0, 0.0],
         0.75,
         epsilon=0.25)
    case("empty_table", "an empty table", np.zeros((0, 1)), [], [a], [-5.0], 0.75)
    third = [[1 / 8], [2 / 8], [3 / 8]]
    case("mean_of_equals", "a rounded mean of equal e exceeds them: d = e is optimal whatever the weights", third,
         [0.1, 0.1, 0.1], [a, [0.7001953125], [0.2998046875], [0.123046875]], [0.1] * 4, 0.75, [False] * 4, K=3)
    case("alpha_zero", "alpha 0", [a], [1.0], [a, a], [0.0, 2.0], 0.0)
    case("alpha_one", "alpha 1: plain ODT", [a], [1.0], [a, a], [0.0, 2.0], 1.0)
    case("between",
         "d between the smaller and the larger e: against the weighted mean, not against either", [a, b], [0.0, 1.0],
         [a, a, b, b], [0.43, 0.44, 0.56, 0.57],
         0.5,
         K=2)
    f.save()


# ----------------------------------------------------------------------------------------------------------------------
# objective and optimizer


def mean_over(lengths, x):
    """Over the steps of each window, then over windows."""
    return sum(part.mean() for part in torch.split(x, list(lengths))) / len(lengths)


def objective_of(head, policy, actions, remembered, w, lengths, noise, lam):
    if head == "categorical":
        log_prob = lambda a: policy[0][np.arange(len(a)), a]
        entropy = -(torch.exp(policy[0]) * policy[0]).sum(-1)
    elif head == "gaussian":
        log_prob = lambda a: gaussian_log_prob(*policy, torch.as_tensor(a))
        entropy = gaussian_entropy(*policy, torch.as_tensor(noise))
    else:
        log_prob = lambda a: -((policy[0] - torch.as_tensor(a))**2).mean(-1)
        entropy = None
    w = torch.as_tensor(np.float64(w))
    L = -mean_over(lengths, w * log_prob(actions)) - mean_over(lengths, (1 - w) * log_prob(remembered))
    if entropy is None:
        return L, None, L
    H = mean_over(lengths, entropy)
    return L, H, L - lam * H


def objective():
    f = File("objective",
             "WODTEM eq. (1), WODTEM eq. (2), WODTEM eq. (3), WODTEM eq. (8), WODTEM eq. (9), WODTEM eq. (10)")

    def case(name, note, lengths, w, head="gaussian", lam=0.1, eta=-2.0, equal=False, A=2, scale=1.0):
        n, log_lambda = sum(lengths), float(np.float32(math.log(lam)))
        w = np.float32(w).astype(np.float64)
        if head == "categorical":
            x = {"logits": tensor(paint(1, n, 5, scale=2.0))}
            policy = [torch.log_softmax(x["logits"], -1)]
            actions, remembered = (np.arange(n) * 3) % 5, (np.arange(n) * 2 + 1) % 5
        elif head == "gaussian":
            x = {"mean": tensor(paint(1, n, A)), "log_std": tensor(paint(30, n, A, scale=scale))}
            policy = list(x.values())
            actions, remembered = paint(20, n, A), paint(77, n, A)
        else:
            x = {"raw": tensor(paint(1, n, A))}
            policy = [torch.tanh(x["raw"])]
            actions, remembered = paint(20, n, A), paint(77, n, A)
        if equal:
            remembered = actions
        noise = paint(60, n, A, scale=2.0)
        L, H, loss = objective_of(head, policy, actions, remembered, w, lengths, noise, math.exp(log_lambda))
        inputs = dict(x, lengths=np.array(lengths), weights=w, actions=actions, remembered_actions=remembered)
        if H is not None:
            inputs["log_temperature"] = np.float64(log_lambda)
        if head == "gaussian":
            inputs["noise"] = noise
        outputs = {"L": L, "loss": loss}
        g = torch.autograd.grad(loss, list(x.values()))
        if H is not None:
            outputs["H"] = H
            # Adam's first step on log lambda: its size is the learning rate, its sign that of lambda (H - eta).
            slope = math.exp(log_lambda) * (float(H) - eta)
            outputs["log_temperature"] = np.array(log_lambda - 1e-4 * slope / (abs(slope) + 1e-8))
        outputs.update({"gradient/" + key: value for key, value in zip(x, g)})
        scale_of = min(float(v.detach().abs().max()) for k, v in outputs.items() if k != "log_temperature")
        spread = max(1.0, float(max(abs(p).max() for p in policy)))
        bound = (n + 64) * U * 8 * spread / min(1.0, scale_of)
        f.case(name, note, f"float64 1e-12, float32 {bound:.2g}: {n} + 64 roundings of terms up to {8 * spread:.2g}",
               TORCH, inputs, outputs, **({} if H is None else {"eta": eta}))
        f.tolerance(name, "gradient", f"float64 1e-10, float32 {bound * 4:.2g}: as the case, through two squares")
        if H is not None:
            f.tolerance(name, "log_temperature", f"float32 {24 * U:.2g}: of the step, which rounds 24 times")

    half = lambda n: np.where(np.arange(n) % 2 == 0, 1.0, 0.75)
    for head in ("gaussian", "categorical"):
        case(head + "_mixed", "second_term_missing, w and 1 - w exchanged; the sign of H", [3, 3], half(6), head)
        case(head + "_window_mean", "window_mean against batch_mean: steps of short windows count more", [1, 4, 2],
             half(7), head)
        case(head + "_alpha_zero", "alpha 0: where all fall short only the remembered actions count", [2, 3],
             np.zeros(5), head)
        case(head + "_alpha_one", "alpha 1: eq. (9) is eq. (2), the remembered actions do not count", [2, 3],
             np.ones(5), head)
        case(head + "_none_short",
             "the same loss as alpha 1 with the actions remembered: w + (1 - w) = 1", [2, 3],
             half(5),
             head,
             equal=True)
        case(head + "_one_step", "one window of one step", [1], [0.75], head)
    case("dt", "DT: the squared error, no entropy term", [2, 2], np.ones(4), "deterministic")
    case("H_above_eta", "lambda falls when H is above eta", [3], np.ones(3), eta=-5.0)
    case("H_below_eta", "lambda rises when H is below eta: lambda_gradient_leaks, its sign", [3], np.ones(3), eta=5.0)
    # H = log_std + log(2 pi) / 2 with mean and noise 0, and float32 takes -0.5 from it exactly.
    at = float(np.float32(0.5 * math.log(2 * math.pi))) - 0.5
    zero, half_down = np.zeros((1, 1)), np.full((1, 1), -0.5)
    L = -gaussian_log_prob(torch.tensor(zero), torch.tensor(half_down), torch.tensor(zero + 0.25)).mean()
    f.case("H_at_eta",
           "lambda rests when H is eta exactly (in float32)",
           "float64 1e-12, float32 1e-06: a dozen roundings",
           CLOSED, {
               "mean": zero, "log_std": half_down, "actions": zero + 0.25, "noise": zero, "log_temperature":
               np.float64(-2.5)},
           {"L": L, "H": np.array(0.5 * math.log(2 * math.pi) - 0.5), "log_temperature": np.float64(-2.5)},
           eta=repr(at))
    f.tolerance("H_at_eta", "log_temperature", "exact: no step")
    case("large_lambda", "padding_in_entropy; lambda times H, not log lambda times H", [2, 1], half(3), lam=4.0)
    f.save()


class PeerOptimizer:
    """LAMB or AdamW over a dictionary of tensors, in float64, from the papers, with ODT's choices."""

    def __init__(self, rule, lr, wd=0.0, clip=0.25, warmup=0, betas=(0.9, 0.999), eps=1e-8, always=False, steps=0):
        self.rule, self.lr, self.wd, self.clip, self.warmup = rule, lr, wd, clip, warmup
        self.betas, self.eps, self.always, self.steps = betas, eps, always, steps
        self.m, self.v = {}, {}

    def step(self, p, g):
        """p, g: name -> array. Changes p; returns the norm of g."""
        norm = math.sqrt(sum(float((x * x).sum()) for x in g.values()))
        scale = min(1.0, self.clip / (norm + 1e-6)) if self.clip > 0 else 1.0
        lr = self.lr * min(1.0, (self.steps + 1) / self.warmup if self.warmup else 1.0)
        self.steps += 1
        b1, b2 = self.betas
        for name in p:
            x = g[name] * scale
            m = self.m[name] = b1 * self.m.get(name, 0 * x) + (1 - b1) * x
            v = self.v[name] = b2 * self.v.get(name, 0 * x) + (1 - b2) * x * x
            u = (m / (1 - b1**self.steps)) / (np.sqrt(v / (1 - b2**self.steps)) + self.eps)
            trust = 1.0
            if self.rule == "lamb":
                u = u + self.wd * p[name]
                a, b = np.sqrt((p[name]**2).sum()), np.sqrt((u**2).sum())
                if (self.wd != 0 or self.always) and a > 0 and b > 0:
                    trust = a / b
            else:
                p[name] = p[name] * (1 - lr * self.wd)
            p[name] = p[name] - lr * trust * u
        return norm


def optimizer():
    f = File("optimizer", "none: LAMB as ODT has it, AdamW, Adam")

    def case(name, note, parameters, g, **settings):
        """parameters: name -> array; g: name -> [steps, ...]."""
        renamed = {"weight_decay": "wd", "clip_norm": "clip", "warmup_updates": "warmup", "optimizer_epsilon": "eps",
                   "learning_rate": "lr", "updates_before": "steps"}
        arguments = {renamed[k]: v for k, v in settings.items() if k in renamed}
        arguments["betas"] = (settings.get("beta1", 0.9), settings.get("beta2", 0.999))
        o = PeerOptimizer(settings.get("optimizer", "lamb"), always=settings.get("always_adapt", 0) == 1, **arguments)
        p = {k: np.array(v, dtype=np.float64) for k, v in parameters.items()}
        after, norms = {k: [] for k in p}, []
        steps = len(next(iter(g.values())))
        for i in range(steps):
            norms.append(o.step(p, {k: v[i] for k, v in g.items()}))
            for k in p:
                after[k].append(p[k].copy())
        inputs = {"parameter/" + k: v for k, v in parameters.items()}
        inputs.update({"gradient/" + k: v for k, v in g.items()})
        outputs = {"after/" + k: np.array(v) for k, v in after.items()}
        outputs["norm"] = np.array(norms)
        f.case(
            name, note,
            f"float32 {24 * U:.2g}: of a step, which rounds 24 times; storing parameters is counted by itself", NUMPY,
            inputs, outputs, **settings)

    def gradients_of(shapes, steps, scale=1.0):
        return {k: paint(100 + 31 * i, steps, *shape, scale=scale) for i, (k, shape) in enumerate(shapes.items())}

    shapes = {"a.weight": (4, 3), "b.bias": (5,)}
    p = {k: paint(7 + i, *shape) for i, (k, shape) in enumerate(shapes.items())}
    g = gradients_of(shapes, 5)
    common = {"learning_rate": 0.0625, "weight_decay": 0.125, "clip_norm": 0}
    case("lamb", "the trust ratio: a norm for each tensor; bias_correction_missing; decay_in_moment", p, g, **common)
    case("lamb_without_decay", "without weight decay the trust ratio is left out, as in ODT's code", p, g,
         **dict(common, weight_decay=0))
    case("lamb_always_adapt", "and kept if asked for", p, g, always_adapt=1, **dict(common, weight_decay=0))
    case("adamw",
         "AdamW: the decay goes past the moments and is not in the step's norm",
         p,
         g,
         optimizer="adamw",
         **common)
    case("adam", "Adam on one number, as on log lambda: bias correction, epsilon outside the root",
         {"log_temperature": [-2.25]}, {"log_temperature": np.array([[0.5], [-0.25], [2.0**-20], [0.0], [0.75]])},
         optimizer="adamw", learning_rate=1e-4, weight_decay=0, clip_norm=0)
    case("clip", "the clip counts all tensors together, once", p, gradients_of(shapes, 3, 4.0),
         **dict(common, clip_norm=0.25))
    one = {"a": np.zeros((1, 4)) + [[0.1875, 0.125, 0.0, 0.0]]}
    length = math.hypot(0.1875, 0.125)
    three = lambda x: {"a": np.float64(np.float32(np.stack([one["a"][0] * x] * 2)))}
    q = {"a": paint(3, 4)}
    case("norm_below_clip", "just below the clip the gradient stays as it is", q, three((0.25 - 2e-6) / length),
         **dict(common, clip_norm=0.25, optimizer_epsilon=0.125))
    case("norm_above_clip", "just above it is scaled by clip / (norm + 1e-6)", q, three((0.25 + 1e-3) / length),
         **dict(common, clip_norm=0.25, optimizer_epsilon=0.125))
    case("norm_far_above_clip", "a norm of a hundred times the clip", q, three(100.0),
         **dict(common, clip_norm=0.25, optimizer_epsilon=0.125))
    case("clip_leaves_small_gradients", "a clip that scales small gradients up to the clip: norms of 0.02, 0.07 and "
         "0.005 stay apart, and so do the steps", p,
         {k: v[:3] * 2.0**np.array([-7, -5, -9]).reshape(3, *[1] * (v.ndim - 1)) for k, v in g.items()},
         **dict(common, clip_norm=0.25))
    large = {"norm_8": (4, 3), "norm_90_small_steps": (12, 8), "norm_90_large_steps": (12, 8)}
    sizes = {"norm_8": (4.0, 2.0**-6), "norm_90_small_steps": (16.0, 2.0**-12),
             "norm_90_large_steps": (16.0, 64.0)}
    case("large_norms", "the trust ratio has no bound: a norm above 10 counts whole, so does a ratio above 10, and "
         "nothing is added to the step's norm, however small", {k: paint(7, *s, scale=sizes[k][0])
                                                                for k, s in large.items()},
         {k: paint(100 + 31 * i, 3, *s, scale=sizes[k][1]) for i, (k, s) in enumerate(large.items())},
         learning_rate=0.0625, weight_decay=2.0**-14, clip_norm=0, optimizer_epsilon=1)
    case("zero_gradient", "a gradient of zero: the moments decay, the decay of weights goes on", p,
         {k: np.concatenate([v[:1], 0 * v[:2]]) for k, v in g.items()}, **common)
    case("zero_throughout", "never a gradient: 0 / (0 + epsilon)", p, {k: 0 * v[:2] for k, v in g.items()}, **common)
    case("zero_weight_norm", "a tensor of zeros has trust ratio 1, at its first step",
         dict(p, **{"b.bias": np.zeros(5)}), {k: v[:2]
                                              for k, v in g.items()}, **common)
    case("no_decay_zero_weights", "zeros without weight decay", {"b.bias": np.zeros(5)}, {"b.bias": g["b.bias"][:2]},
         **dict(common, weight_decay=0))
    case("warmup", "linear warm-up: the first update has a fifth, the fifth and all later ones the whole", p,
         gradients_of(shapes, 7), warmup_updates=5, **common)
    f.save()


# ----------------------------------------------------------------------------------------------------------------------
# sampling, normalize, gridworld


def sampling():
    f = File("sampling", "WODTEM sec. III-A: D_offline, D_online, first in, first out; sub-trajectories")

    def case(name, note, lengths, returns_, order, context_length=3, draws=None, **settings):
        """order: written out by hand. rewards: 0, but for a trajectory's last step."""
        rewards = np.concatenate([np.eye(1, n, n - 1)[0] * r for n, r in zip(lengths, returns_)])
        inputs = {"rewards": rewards, "lengths": np.array(lengths)}
        outputs = {"order": np.array(order)}
        steps = [(place, start) for place, i in enumerate(order) for start in range(lengths[i])]
        if draws is None:
            draws = list(range(len(steps)))
        chosen = [steps[d] for d in draws]
        inputs["draws"] = np.array(chosen if settings.get("sampling") == "uniform" else draws)
        outputs["trajectory"] = np.array([place for place, _ in chosen])
        outputs["start"] = np.array([start for _, start in chosen])
        outputs["length"] = np.array([min(context_length, lengths[order[place]] - start) for place, start in chosen])
        f.case(name, note, "exact: whole numbers", CLOSED + ", all steps written out", inputs, outputs,
               context_length=context_length, **settings)

    case("by_length",
         "a trajectory in proportion to its length, a start uniform over its steps, windows cut at the end", [4, 1, 6],
         [1.0, 2.0, 3.0], [0, 1, 2])
    case("one_trajectory", "one trajectory of one step", [1], [1.0], [0])
    case("context_one", "C = 1", [2, 3], [1.0, 2.0], [0, 1], 1)
    case("sorted_start",
         "sorted_start: the buffer begins sorted from low to high return, equal ones in order of the data",
         [2, 3, 1, 2], [5.0, -1.0, 5.0, 2.0], [1, 3, 0, 2])
    case("best_stay", "where the data set is larger than the buffer, the highest returns stay; of equal ones the later",
         [2, 3, 1, 2], [5.0, -1.0, 2.0, 2.0], [3, 0], capacity=2)
    case("overwrite_order", "overwrite_order: full by one: the lowest offline return goes first, then place by place",
         [1, 2, 3, 4, 5], [3.0, 1.0, 2.0, 0.0, 0.0], [3, 4, 0], initial=3, capacity=3)
    case("fills_up", "a buffer that is not full takes in new trajectories behind the old", [1, 2, 3], [3.0, 1.0, 9.0],
         [1, 0, 2], initial=2, capacity=4)
    case("laps", "lap after lap", [1, 2, 3, 4, 5, 6], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], [4, 5], initial=2, capacity=2)
    case("drops_lowest", "ODT's code drops the offline trajectory of the lowest return, of several the first",
         [2, 3, 1, 2], [5.0, -1.0, -1.0, 2.0], [2, 3, 0], keep_lowest=0)
    case("uniform", "trajectories alike: a place of the buffer and a step of its trajectory; windows cut at the end",
         [4, 1, 6], [2.0, 3.0, 1.0], [2, 0, 1], draws=[0, 3, 5, 6, 9, 10], sampling="uniform")
    f.save()


def normalize():
    f = File("normalize", "none: D4RL's normalised score; ODT's normalised states")
    scores = {"hopper": (-20.272305, 3234.3), "walker2d": (1.629008, 4592.3), "halfcheetah": (-280.178953, 12135.0),
              "ant": (-325.6, 3879.7), "maze2d-umaze": (23.85, 161.86), "maze2d-medium": (13.13, 277.39),
              "maze2d-large": (6.7, 273.99), "antmaze-umaze": (0.0, 1.0)}
    for task, (low, high) in scores.items():
        f.case("score_" + task.replace("-", "_"),
               "the two reference returns of the task are 0 and 100, and the middle is 50",
               "float64 1e-12: three operations in double",
               "published: D4RL's reference scores", {"returns": np.array([low, high, (low + high) / 2, 0.0])},
               {"score": np.array([0.0, 100.0, 50.0, 100 * (0 - low) / (high - low)])},
               task=task)

    def case(name, note, states):
        mean, deviation = states.mean(0), np.sqrt(((states - states.mean(0))**2).mean(0)) + 1e-6
        varies = deviation > 1e-5  # elsewhere all states are the mean, exactly
        worst = float(max([1.0, *(np.abs(states).max(0) / deviation)[varies]]))
        y = (states - mean) / deviation
        f.case(name, note, f"float32 {2 * U:.2g}: computed in double, rounded once", NUMPY, {"states": states},
               {"mean": mean, "deviation": deviation, "normalised": y})
        f.tolerance(
            name, "normalised",
            f"float32 {4 * worst * U / (np.abs(y).max() or 1):.2g}: float32 states less a rounded mean: "
            "what cancels is lost")

    case("states", "population deviation (1/n), 1e-6 added to it, not under the root", paint(1, 12, 3))
    constant = paint(1, 6, 3)
    constant[:, 1] = 0.75
    case("constant_dimension", "a dimension that never changes has deviation 1e-6, and is 0", constant)
    case("one_state", "one state", paint(1, 1, 2))
    f.save()


MOVES = [(0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (-1, 1), (1, -1), (-1, -1)]  # R D L U R-D R-U L-D L-U


def grid_next(cell, move, edge):
    row, column = cell // 6 + MOVES[move][0], cell % 6 + MOVES[move][1]
    if edge == "wraps":
        return row % 6 * 6 + column % 6
    if edge == "clipped":
        return min(max(row, 0), 5) * 6 + min(max(column, 0), 5)
    return row * 6 + column if 0 <= row < 6 and 0 <= column < 6 else cell


def gridworld():
    f = File("gridworld", "WODTEM sec. IV-A")
    cells, moves = [x.ravel() for x in np.meshgrid(np.arange(36), np.arange(8), indexing="ij")]
    for edge, note in (("clipped", "per-axis clipping: a diagonal slides along the wall; rows and columns exchanged"),
                       ("stays", "a move off the grid is void as a whole"), ("wraps", "a torus"),
                       ("excluded", "a move off the grid, should a policy choose one, is void")):
        f.case("all_moves_" + edge, note, "exact: whole numbers", SEARCH, {"cell": cells, "move": moves},
               {"next_cell": np.array([grid_next(c, m, edge) for c, m in zip(cells, moves)])}, edge=edge)
    on = cells != 35
    after = np.array([grid_next(c, m, "clipped") for c, m in zip(cells[on], moves[on])])
    for encoding, state in (("coordinates", np.stack([after // 6, after % 6], 1).astype(np.float64)),
                            ("one_hot", np.eye(36)[after].astype(np.uint8))):
        f.case("all_steps_" + encoding,
               "reward 1 on arriving at the goal alone, where the episode ends; the state after the move",
               "exact: whole numbers",
               SEARCH, {"cell": cells[on], "move": moves[on]}, {
                   "next_cell": after, "reward": (after == 35).astype(np.float64), "terminated":
                   (after == 35).astype(np.int64), "state": state},
               encoding=encoding)
    path = [0, 7, 14, 21, 28]
    f.case("shortest_path", "the shortest path has five steps, all R-D; the first four do not arrive",
           "exact: whole numbers", SEARCH, {"cell": np.array(path), "move": np.full(5, 4)}, {
               "next_cell": np.array(path[1:] + [35]), "reward": np.array([0.0, 0, 0, 0, 1]), "terminated": np.array([
                   0, 0, 0, 0, 1])})
    for behaviour, sideways in (("right_down", 0), ("left_down", 2)):
        for edge in ("clipped", "stays", "wraps", "excluded"):
            P = np.zeros((36, 36))
            for cell in range(35):
                share = np.array([0.2 if m in (sideways, 1) else 0.1 for m in range(8)])
                if edge == "excluded":
                    inside = [0 <= cell // 6 + r < 6 and 0 <= cell % 6 + c < 6 for r, c in MOVES]
                    share = share * inside / (share * inside).sum()
                for m in range(8):
                    P[cell, grid_next(cell, m, edge)] += share[m]
            P[35, 35] = 1
            alive = [1 - np.linalg.matrix_power(P, t)[0, 35] for t in range(101)]
            length = sum(alive[:100])
            square = sum((2 * t + 1) * alive[t] for t in range(100))
            p = 1 - alive[100]
            f.case(f"chain_{behaviour}_{edge}",
                   "the behaviour policy's mean length and return, by powers of the transition matrix",
                   "float64 1e-12: a hundred sums of 36 probabilities",
                   CLOSED, {}, {
                       "mean_length": np.array(length), "mean_return": np.array(p), "sd_length": np.array(
                           math.sqrt(square - length**2)), "sd_return": np.array(math.sqrt(p * (1 - p)))},
                   behaviour=behaviour,
                   edge=edge)
            f.tolerance(f"chain_{behaviour}_{edge}", "sd_length", "float64 1e-11: the square of the mean is subtracted")
    f.save()


# ----------------------------------------------------------------------------------------------------------------------
# step: whole updates


def step():
    f = File(
        "step",
        "WODTEM eq. (1), WODTEM eq. (2), WODTEM eq. (3), WODTEM eq. (8), WODTEM eq. (9), "
        "WODTEM eq. (10); "
        "the network, its gradients and both optimisers"
    )

    def case(name, note, head="gaussian", lengths=(4, 2, 3), w=None, layers=2, heads=2, d=8, state_dim=3, action_dim=2,
             positions=0, updates=10, optimizer="lamb", held=(1, 10), lr=0.015625, wd=0.0078125, warmup=4, clip=0.25,
             eta=None, full=False, timesteps=None):
        n, windows = sum(lengths), len(lengths)
        p = painted_parameters(parameter_shapes(state_dim, action_dim, layers, d, head, positions))
        R, s = paint(11, n), paint(1, n, state_dim)
        t = np.concatenate([np.arange(m) + 2 * i for i, m in enumerate(lengths)])
        if head == "categorical":
            actions, remembered = (np.arange(n) * 3) % action_dim, (np.arange(n) * 2 + 1) % action_dim
            a = np.eye(action_dim)[actions]
        else:
            actions, remembered = paint(50, n, action_dim), paint(77, n, action_dim)
            a = actions
        w = np.where(np.arange(n) % 3 == 1, 0.75, 1.0) if w is None else w
        noise = np.stack([paint(200 + 41 * u, n, action_dim, scale=2.0) for u in range(updates)])
        log_lambda, eta = float(np.float32(math.log(0.1))), -float(action_dim) if eta is None else eta
        inputs = {"parameter/" + k: v.detach().clone() for k, v in p.items()}
        shape = (lambda x: x.reshape(windows, lengths[0], *x.shape[1:])) if full else (lambda x: x)
        inputs.update({"returns_to_go": shape(R), "states": shape(s), "actions": shape(actions)})
        if not full:
            inputs["lengths"] = np.array(lengths)
        if head != "deterministic":
            inputs.update({"remembered_actions": shape(remembered), "weights": shape(w),
                           "log_temperature": np.float64(log_lambda)})
        if positions:
            inputs["timesteps"] = shape(t)
        if head == "gaussian":
            inputs["noise"] = np.stack([shape(x) for x in noise])
        batch = split_windows(lengths, R, s, a, t)

        def run(p, storage):
            """All updates, with parameters kept as `storage`."""
            theta, temperature = PeerOptimizer(optimizer, lr, wd, clip, warmup), PeerOptimizer("adamw", 0.03125, 0, 0)
            lists = {"loss": [], "L": [], "H": [], "gradient_norm": [], "log_temperature": []}
            outputs = {}
            state = {"log_temperature": np.array([log_lambda])}
            for u in range(1, updates + 1):
                layer, rows = network(p, batch, heads)
                if u == 1:
                    for parts in layer.values():
                        for part in parts:
                            part.retain_grad()
                policy = [torch.cat(layer[x]) for x in ("policy.mean", "policy.log_std") if x in layer]
                L, H, loss = objective_of(head, policy, actions, remembered if head != "deterministic" else actions,
                                          w if head != "deterministic" else np.ones(n), lengths, noise[u - 1],
                                          math.exp(state["log_temperature"][0]))
                loss.backward()
                g = {k: v.grad.numpy() for k, v in p.items()}
                if u == 1:
                    outputs.update({"gradient/" + k: x.copy() for k, x in g.items()})
                    for x in layer if updates == 10 else ():
                        outputs["layer/" + x] = packed(layer[x], rows[x])
                        outputs["layer_gradient/" + x] = packed([part.grad for part in layer[x]], rows[x])
                values = {k: v.detach().numpy().copy() for k, v in p.items()}
                lists["gradient_norm"].append(theta.step(values, g))
                lists["loss"].append(float(loss))
                lists["L"].append(float(L))
                if H is not None:
                    slope = math.exp(state["log_temperature"][0]) * (float(H) - eta)
                    temperature.step(state, {"log_temperature": np.array([slope])})
                    lists["H"].append(float(H))
                    lists["log_temperature"].append(float(state["log_temperature"][0]))
                p = {k: torch.tensor(np.float64(storage(v)), requires_grad=True) for k, v in values.items()}
                if u in held:
                    store = np.float64 if lr < 1e-6 else np.float32
                    outputs.update({f"after_{u}/{k}": store(v) for k, v in values.items()})
            return lists, outputs

        lists, outputs = run(p, np.float64)
        outputs.update({k: np.array(v) for k, v in lists.items() if v})
        chain = 2 + state_dim + layers * (2 * (d + 8) + 4 * d + d // heads + 3 * max(lengths)) + d
        k = math.ceil(8 * math.sqrt(2 * chain))  # rounding errors are as good as independent: Higham and Mary, 2019
        settings = {
            "heads": heads, "optimizer": optimizer, "learning_rate": lr, "weight_decay": wd, "warmup_updates": warmup,
            "clip_norm": clip}
        if head != "deterministic":
            settings.update({"lambda_learning_rate": 0.03125, "eta": eta})
        f.case(
            name, note,
            f"float64 1e-12, float32 {k * U:.2g}: 8 roots of the {2 * chain} roundings there and back",
            TORCH, inputs, outputs, **settings)
        f.tolerance(name, "gradient", f"float64 1e-10, float32 {k * U:.2g}: as the case")
        if updates == 10:
            f.tolerance(name, "layer_gradient", f"float64 1e-10, float32 {k * U:.2g}: as the case")
        for u in held:
            f.tolerance(
                name, f"after_{u}",
                f"float32 {24 * U:.2g}: of the steps, which round 24 times; what storing parameters and rounding of "
                "the gradients do is counted by itself")
        # Steps that float32 swallows add up in float64, as here: twice what that does to each list is allowed.
        swallowed = run(painted_parameters(parameter_shapes(state_dim, action_dim, layers, d, head, positions)),
                        np.float32)[0] if lr < 1e-6 else lists
        for x in ("loss", "L", "H", "gradient_norm", "log_temperature"):
            if lists[x]:
                apart = 2 * abs(np.array(lists[x]) - swallowed[x]).max() / abs(np.array(lists[x])).max()
                if x == "log_temperature" or apart == 0:
                    f.tolerance(name, x, f"float64 1e-12, float32 {k * U:.2g}: as the case")
                else:
                    f.tolerance(name, x, f"float64 1e-12, float32 {k * U + apart:.2g}: as the case, and {apart:.2g}, "
                                "twice what storing parameters in float32 does")

    case("tiny", "ten whole updates: any mistake that the other files miss; which tensor is wrong first says where")
    case("alpha_one", "plain ODT: all weights 1, full windows given as [windows, C, ...], no lengths", lengths=(3, 3),
         w=np.ones(6), layers=1, full=True, updates=2, held=(2,))
    case("grid",
         "the grid world's shape: C = 1, moves, no weight decay: Adam's step without a trust ratio",
         "categorical", (1, 1, 1, 1),
         layers=1,
         heads=1,
         action_dim=8,
         state_dim=2,
         wd=0,
         eta=-1.0,
         updates=2,
         held=(2, ))
    case("small_steps",
         "steps so small that float32 swallows them: with parameters in float64, as here, or in float32, both are right",
         layers=1,
         lengths=(2, 1),
         lr=2.0**-26,
         warmup=0,
         updates=40,
         held=(40, ))
    case("positions",
         "a table of positions, clipped at its end; its rows without a time-step get no gradient",
         positions=4,
         layers=1,
         lengths=(3, 2),
         updates=1,
         held=(1, ))
    case("dt",
         "DT: tanh, squared error, AdamW, no temperature",
         "deterministic", (2, 3),
         layers=1,
         heads=1,
         positions=6,
         optimizer="adamw",
         updates=2,
         held=(2, ))
    f.save()


# ----------------------------------------------------------------------------------------------------------------------
# run: whole runs on the grid world, one window, one look-up, one step at a time.

SMALL = {  # preset small, of all methods, but for DT's online_steps 0
    "seed": 0, "data_seed": 138129, "data_trajectories": 500, "behaviour": "right_down", "edge": "clipped",
    "state_encoding": "coordinates", "layers": 1, "heads": 1, "width": 8, "context_length": 1, "eval_context": 5,
    "position": "no", "dropout": 0.1, "optimizer": "lamb", "learning_rate": 0.001, "weight_decay": 0,
    "clip_norm": 0.25, "lamb_always_adapt": "no", "warmup_updates": 10000, "batch_size": 256, "offline_updates": 1000,
    "updates_per_iteration": 50, "initial_lambda": 0.1, "lambda_learning_rate": 1e-4, "eta": -1, "online_steps": 20000,
    "buffer_size": 500, "eval_episodes": 1, "eval_every": 10, "g_online": 2, "g_eval": 1, "reward_scale": 1,
    "keep_lowest": "no", "sampling": "uniform", "gamma": 0.99, "alpha": 0.75, "epsilon": 0.1, "tau": 1, "K": 1,
    "projected_dim": 0, "table_size": 36, "keys": "raw", "eviction": "lfu", "exclude_self": "no"}


# The three choices of a run that are made by numbers. None is so close that rounding in float32 could turn it.


def drawn(uniform, odds, actions, near=1e-4):
    """The action whose share of [0, 1) contains the number."""
    ends = np.cumsum(odds)[:-1] / np.sum(odds)
    found = [actions[np.searchsorted(ends, uniform + x, side="right")] for x in (0.0, -near, near)]
    assert found[0] == found[1] == found[2]
    return found[0]


def most_likely(log_p):
    assert np.sort(log_p)[-1] - np.sort(log_p)[-2] > 1e-4
    return int(np.argmax(log_p))


def falls_short(found, d):
    """d below e-hat, as a sum of differences."""
    excess = sum(math.exp(found[0][0] - q) * (entry["e"] - d) for q, entry in found)
    assert excess == 0 or abs(excess) > 1e-5
    return excess > 0


def grid_episode(choose, edge):
    """From the top left to the goal, 100 steps at most. choose: from the episode so far, its last cell the present one,
    to a move."""
    e = {"cells": [0], "moves": [], "rewards": []}
    while len(e["moves"]) < 100 and e["cells"][-1] != 35:
        e["moves"].append(choose(e))
        e["cells"].append(grid_next(e["cells"][-1], e["moves"][-1], edge))
        e["rewards"].append(float(e["cells"][-1] == 35))
    return e


class Run:
    """All that happens in a run, by the names and values of its settings."""

    def __init__(self, **s):
        self.s = s
        self.memory = s["method"] == "wodtem"
        draw = Draw(s["data_seed"], 9)

        def behave(n, e):
            cell = e["cells"][-1]
            odds = np.array([2 if m in (0 if s["behaviour"] == "right_down" else 2, 1) else 1 for m in range(8)])
            if s["edge"] == "excluded":
                odds *= [grid_next(cell, m, "stays") != cell for m in range(8)]
            return int(np.searchsorted(np.cumsum(odds), draw.below(int(odds.sum()), n, len(e["moves"])), side="right"))
        data = [grid_episode(lambda e: behave(n, e), s["edge"]) for n in range(s["data_trajectories"])]
        states = np.concatenate([self.states(e["cells"][:-1]) for e in data])
        self.mean, self.deviation = states.mean(0), states.std(0) + 1e-6
        ranked = sorted(data, key=lambda e: sum(e["rewards"]))  # stable: of equal returns in the data's order
        if s["keep_lowest"] == "no":
            data = [e for e in data if e is not ranked[0]]
            ranked = ranked[1:]
        S = states.shape[1]
        self.p = {k: torch.tensor(np.float64(np.float32(v)), requires_grad=True) for k, v in start_values(
            s["seed"], S, 8, s["layers"], s["width"], "categorical", 1000 * (s["position"] == "yes")).items()}
        self.theta = PeerOptimizer(s["optimizer"], s["learning_rate"], s["weight_decay"], s["clip_norm"],
                                   s["warmup_updates"], always=s["lamb_always_adapt"] == "yes")
        self.log_lambda = {"": np.array([float(np.float32(math.log(s["initial_lambda"])))])}
        self.temperature = PeerOptimizer("adamw", s["lambda_learning_rate"], clip=0)
        projection = start_projection(s["seed"], s["projected_dim"], S) if s["projected_dim"] else None
        self.table = Table(s["table_size"], s["K"], s["epsilon"], s["eviction"], projection, s["exclude_self"] == "yes")
        self.buffer, self.updates, self.interactions, self.episodes = ranked, 0, 0, []
        self.rows, self.since, self.changes = [], [], np.zeros(4, dtype=int)
        for e in data:
            self.take_in(e)

    def go(self):
        s, place = self.s, 0
        for _ in range(s["offline_updates"]):
            self.update()
        self.evaluate()
        self.buffer = self.buffer[-s["buffer_size"]:]
        while self.interactions < s["online_steps"]:
            e = self.act(s["g_online"], Draw(s["seed"], 4), len(self.episodes))
            self.interactions += len(e["moves"])
            self.episodes.append(dict(e, interactions=self.interactions))
            self.take_in(e)
            if len(self.buffer) < s["buffer_size"]:
                self.buffer.append(e)
            else:
                self.buffer[place] = e
                place = (place + 1) % s["buffer_size"]
            for _ in range(s["updates_per_iteration"]):
                self.update()
            if len(self.episodes) % s["eval_every"] == 0 or self.interactions >= s["online_steps"]:
                self.evaluate()
        return self

    def states(self, cells):
        if self.s["state_encoding"] == "one_hot":
            return np.eye(36)[cells]
        return np.stack([np.array(cells) // 6, np.array(cells) % 6], 1).astype(np.float64)

    def normalised(self, cells):
        y = (np.float32(self.states(cells)) - np.float32(self.mean)) / np.float32(self.deviation)
        return y.astype(np.float64)

    def keys(self, cells):
        return self.normalised(cells) if self.s["keys"] == "normalized" else self.states(cells)

    def take_in(self, e):
        """The memory; the buffer is the caller's."""
        e["d"] = sums(e["rewards"], self.s["gamma"])
        if self.memory:
            for key, move, d in zip(self.keys(e["cells"][:-1]), e["moves"], e["d"]):
                self.table.update(self.table.clock, key, move, d)

    def draw_window(self, i):
        """Episode, first step, steps."""
        chance, starts = Draw(self.s["seed"], 3), [(e, t) for e in self.buffer for t in range(len(e["moves"]))]
        if self.s["sampling"] == "by_length":
            e, t = starts[chance.below(len(starts), self.updates, i)]
        else:
            e = self.buffer[chance.below(len(self.buffer), self.updates, i)]
            t = chance.below(len(e["moves"]), self.updates, i, 1)
        return e, t, min(self.s["context_length"], len(e["moves"]) - t)

    def update(self):
        s, B, C = self.s, self.s["batch_size"], self.s["context_length"]
        windows = [self.draw_window(i) for i in range(B)]
        lengths = [n for _, _, n in windows]
        gather = lambda of: np.concatenate([np.array(of(e))[t:t + n] for e, t, n in windows])
        moves, d = gather(lambda e: e["moves"]), gather(lambda e: e["d"])
        time = gather(lambda e: np.arange(len(e["moves"])))
        R = gather(lambda e: sums(e["rewards"], 1.0) * s["reward_scale"])
        row = {"learning_rate": s["learning_rate"] * min(1.0, (self.updates + 1) / max(1, s["warmup_updates"]))}

        remembered, w, short, accessed = moves.copy(), np.ones(len(moves)), np.zeros(len(moves), dtype=bool), []
        if self.memory:
            cells, uniform = gather(lambda e: e["cells"][:-1]), Draw(s["seed"], 5)
            place = np.concatenate([i * C + np.arange(n) for i, n in enumerate(lengths)])
            nearest = {cell: self.table.nearest(self.keys([cell])[0]) for cell in set(cells)}
            row["unmatched"] = [not nearest[cell] for cell in cells]
            for j, cell in enumerate(cells):
                found = nearest[cell]
                accessed += [entry for _, entry in found]
                if falls_short(found, d[j]):
                    short[j] = True
                    remembered[j] = drawn(uniform.uniform(self.updates, int(place[j])),
                                          [math.exp(entry["e"] / s["tau"]) for _, entry in found],
                                          [entry["action"] for _, entry in found], near=1e-5)
            w[short] = s["alpha"]
            row["short"] = short
            c = (1 - w) / (B * np.repeat(lengths, lengths))
            row["advice"], row["advice_distance"] = c.sum(), c[remembered != moves].sum()
            row["shift"] = np.bincount(remembered, c, 8) - np.bincount(moves, c, 8)

        P, policy = -(-B // max(1, 2048 // (3 * C))), []
        batch = split_windows(lengths, R, self.normalised(gather(lambda e: e["cells"][:-1])), np.eye(8)[moves], time)
        for part in range(P):
            some = slice(B * part // P, B * (part + 1) // P)
            mask = Mask(lengths[some], s["layers"], s["heads"], s["dropout"], self.updates, s["seed"], part)
            policy += network(self.p, batch[some], s["heads"], mask)[0]["policy.mean"]
        lam = math.exp(self.log_lambda[""][0])
        L, H, loss = objective_of("categorical", [torch.cat(policy)], moves, remembered, w, lengths, None, lam)
        g = torch.autograd.grad(L if s["method"] == "dt" else loss, list(self.p.values()))
        for entry in accessed:
            self.table.touch(entry)
        values = {k: v.detach().numpy() for k, v in self.p.items()}
        row["gradient_norm"] = self.theta.step(values, {k: x.numpy() for k, x in zip(values, g)})
        self.p = {k: torch.tensor(v, requires_grad=True) for k, v in values.items()}
        row["loss"] = float(L)
        if s["method"] != "dt":
            row["entropy"] = float(H)
            self.temperature.step(self.log_lambda, {"": np.array([lam * (float(H) - s["eta"])])})
        self.since.append(row)
        self.updates += 1

    def act(self, target, chance=None, episode=0):
        """An episode: sampled, or, without chance, the most likely moves."""
        s = self.s
        told, context = [np.float32(target * s["reward_scale"])], min(s["eval_context"], s["context_length"])

        def choose(e):
            t = len(e["moves"])
            if t > 0:
                told.append(told[-1] - np.float32(e["rewards"][-1] * s["reward_scale"]))
            steps = np.arange(max(0, t + 1 - context), t + 1)
            window = (np.float64(told)[steps], self.normalised(e["cells"])[steps],
                      np.eye(8)[e["moves"] + [0]][steps])  # the present step's action is not seen
            window = [torch.tensor(x) for x in window] + [steps]
            log_p = network(self.p, [window], s["heads"])[0]["policy.mean"][0][-1].detach().numpy()
            if chance is not None:
                return drawn(chance.uniform(episode, t), np.exp(log_p), np.arange(8))
            return most_likely(log_p)
        return grid_episode(choose, s["edge"])

    def evaluate(self):
        none = math.nan
        of = lambda name: np.concatenate([[none]] + [np.atleast_1d(row[name]) for row in self.since if name in row])[1:]
        mean = lambda x: np.mean(x) if len(x) else none
        tried = [self.act(self.s["g_eval"]) for _ in range(self.s["eval_episodes"])]
        fresh = self.episodes[self.rows[-1]["episodes"] if self.rows else 0:]
        length = lambda episodes: mean([len(e["moves"]) for e in episodes])
        total = lambda episodes: mean([sum(e["rewards"]) for e in episodes])
        changes, self.changes = np.array(self.table.changes) - self.changes, np.array(self.table.changes)
        shift = sum(row["shift"] for row in self.since) / len(self.since) if self.memory else none
        self.rows.append({
            "updates": self.updates, "interactions": self.interactions, "episodes": len(self.episodes),
            "learning_rate": self.since[-1]["learning_rate"],
            "lambda": none if self.s["method"] == "dt" else math.exp(self.log_lambda[""][0]),
            "memory": len(self.table.entries), "eval_length": length(tried),
            "eval_return": total(tried), "loss": mean(of("loss")), "entropy": mean(of("entropy")),
            "gradient_norm": mean(of("gradient_norm")), "short": mean(of("short")), "unmatched": mean(of("unmatched")),
            "rollout_length": length(fresh), "rollout_return": total(fresh),
            "matched": changes[1] + changes[2], "evicted": changes[3], "advice": mean(of("advice")),
            "advice_distance": mean(of("advice_distance")), "advice_shift": 0.5 * np.abs(shift).sum()})
        self.since = []


def run():
    f = File("run", "WODTEM sec. IV-A, sec. IV-B and sec. V-D: the algorithm on the grid world, from data to the log")

    def case(name, note, **given):
        r = Run(**dict(SMALL, **given)).go()
        outputs = {"progress/" + key: np.array([row[key] for row in r.rows]) for key in r.rows[0]}
        if r.episodes:
            each = lambda of: np.array([of(e) for e in r.episodes])
            outputs.update({
                "episodes/interactions": each(lambda e: e["interactions"]),
                "episodes/length": each(lambda e: len(e["moves"])),
                "episodes/return": each(lambda e: int(sum(e["rewards"]))),
                "episodes/terminated": each(lambda e: int(e["cells"][-1] == 35)),
                "episodes/actions": np.concatenate([e["moves"] for e in r.episodes])})
        f.case(name, note, "float32 1e-05: tried in float32, this peer was off by 6e-07 at most", TORCH, {}, outputs,
               **dict({key: SMALL[key] for key in ("seed", "layers", "heads", "width", "dropout")}, **given))
        for key, bound in (("loss", 1e-4), ("entropy", 1e-4), ("gradient_norm", 1e-3)):
            f.tolerance(name, "progress/" + key, f"float32 {bound:.2g}: what errors of 1e-6 in the gradients came to")

    # Targets far from the returns of the data, and large steps: so the moves tell which target and context were used.
    case("odt", "the order of a run: the trajectory of the lowest return is dropped; episode, updates, evaluation; one "
         "warm-up over both phases; the buffer has room for one episode, then is overwritten from place 0 on; the last "
         "episode overruns the budget, and one evaluation follows it", method="odt", seed=61, data_seed=161,
         data_trajectories=12, context_length=1, eval_context=5, batch_size=16, learning_rate=0.02, warmup_updates=32,
         lambda_learning_rate=0.01, offline_updates=20, online_steps=250, updates_per_iteration=4, buffer_size=12,
         eval_every=2, eval_episodes=1, g_online=-4, g_eval=1)
    case("dt", "DT on the grid world: moves, likelihood alone, no online phase; time-steps count from the episode's "
         "start; acting has a context of its own", method="dt", seed=5, data_seed=205, data_trajectories=8, heads=2,
         width=12, position="yes", context_length=4, eval_context=3, batch_size=8, optimizer="adamw", weight_decay=0.1,
         learning_rate=0.02, warmup_updates=10, offline_updates=30, updates_per_iteration=50, online_steps=0,
         buffer_size=500, eval_every=10, eval_episodes=1)
    case("wodtem", "the memory in a run: what it takes in when, its look-ups count as accesses, a full table; a batch "
         "in three parts, each with its own dropout", method="wodtem", seed=7, data_seed=107, data_trajectories=20,
         layers=2, heads=2, context_length=20, eval_context=5, batch_size=70, learning_rate=0.03, warmup_updates=5,
         lambda_learning_rate=0.01, offline_updates=8, online_steps=120, updates_per_iteration=2, buffer_size=15,
         eval_every=1, eval_episodes=1, gamma=0.99, alpha=0.75, K=3, epsilon=1.5, table_size=20)
    case("wodtem_other_choices", "what the other cases leave as it is; online episodes overwrite all of the buffer. "
         "Projected, the shifts (4, 1) and (3, 1) are the shortest, and no two neighbours are equally far, whose order "
         "would be rounding's", method="wodtem", seed=2112, data_seed=9, data_trajectories=10, behaviour="left_down",
         edge="excluded", keep_lowest="yes", sampling="by_length", heads=2, width=12, context_length=3, eval_context=2,
         batch_size=16, dropout=0.25, learning_rate=0.0575, warmup_updates=10, weight_decay=0.01, clip_norm=0.0625,
         lambda_learning_rate=0.01, offline_updates=15, online_steps=300, updates_per_iteration=3, buffer_size=5,
         eval_every=5, eval_episodes=2, g_online=-1, g_eval=3, reward_scale=4, gamma=0.9, alpha=0.5, tau=0.5, K=3,
         epsilon=0.05, projected_dim=2, table_size=24, keys="normalized", eviction="lru", exclude_self="yes")
    f.save()


# ----------------------------------------------------------------------------------------------------------------------
# env_TASK: gym's and D4RL's rules around MuJoCo's own library, which a few lines of C open to Python. The robots'
# models are data/*.xml but for maze2d's (the tests hold every number of them against tables); mazes are written here from their maps.

SHIM = r"""
#include <mujoco/mujoco.h>
static void quiet(const char* text) { (void)text; }
void* load(const char* path, char* error) { mju_user_warning = quiet; return mj_loadXML(path, 0, error, 500); }
void* make(mjModel* m) { return mj_makeData(m); }
int size(mjModel* m, int what) { return what == 0 ? m->nq : what == 1 ? m->nv : what == 2 ? m->nu : 6 * m->nbody; }
double* of_model(mjModel* m, int what) {
    return what == 0 ? m->qpos0 : what == 1 ? m->actuator_ctrlrange : &m->opt.timestep;
}
double* of_data(mjData* d, int what) {
    return what == 0 ? d->qpos : what == 1 ? d->qvel : what == 2 ? d->ctrl : what == 3 ? d->xpos : d->cfrc_ext;
}
void reset(mjModel* m, mjData* d) { mj_resetData(m, d); }
void forward(mjModel* m, mjData* d) { mj_forward(m, d); }
void step(mjModel* m, mjData* d) { mj_step(m, d); }
"""
MAPS = {"maze2d-umaze": "11111 1G001 11101 10001 11111",
        "maze2d-medium": "11111111 10011001 10010001 11000111 10010001 10100101 100010G1 11111111",
        "maze2d-large": "111111111111 100001000001 101101010101 100000010001 101111011101 100101000001 110101010111 "
                        "100100010G01 111111111111",
        "antmaze-umaze": "11111 1R001 11101 1G001 11111"}


def walls(task):
    return [(i, j) for i, row in enumerate(MAPS[task].split()) for j, c in enumerate(row) if c == "1"]


def maze2d_xml(task):
    boxes = "".join(f'<geom type="box" size=".5 .5 .2" pos="{i + 1} {j + 1} 0"/>' for i, j in walls(task))
    return f"""<mujoco><option timestep="0.01" gravity="0 0 0" iterations="20" integrator="Euler"/>
    <size njmax="500" nconmax="100"/>
    <default><geom friction=".5 .1 .1" density="1000" margin="0.002" condim="1" contype="2" conaffinity="1"/></default>
    <worldbody><geom type="plane" pos="0 0 -0.1" size="40 40 .25" contype="1" conaffinity="0"/>{boxes}
    <body pos="1.2 1.2 0"><joint name="a" type="slide" axis="1 0 0" damping="1"/>
    <joint name="b" type="slide" axis="0 1 0" damping="1"/><geom type="sphere" size="0.1" contype="1"/></body>
    </worldbody>
    <actuator><motor joint="a" gear="100" ctrllimited="true" ctrlrange="-1 1"/>
    <motor joint="b" gear="100" ctrllimited="true" ctrlrange="-1 1"/></actuator></mujoco>"""


def antmaze_xml(ant):
    boxes = "".join(f'<geom type="box" size="2 2 1" pos="{4 * (j - 1)} {4 * (i - 1)} 1" conaffinity="1"/>'
                    for i, j in walls("antmaze-umaze"))
    for old, new in (('timestep="0.01"', 'timestep="0.02"'), ('margin="0.01"/>',
                                                              'margin="0.01" solimp="0.8 0.8 0.01"/>'),
                     ('ctrlrange="-1 1" gear="150"', 'ctrlrange="-30 30" gear="1"'), ("</worldbody>",
                                                                                      boxes + "</worldbody>")):
        assert ant.count(old) == 1, old
        ant = ant.replace(old, new)
    return ant


class Engine:
    def __init__(self, task, library):
        import ctypes
        import tempfile
        self.task, self.c = task, library
        name = {"antmaze-umaze": "ant"}.get(task, task)
        if task.startswith("maze2d"):
            xml = maze2d_xml(task)
        else:
            with open(os.path.join(HERE, "..", "..", "data", name + ".xml")) as file:
                xml = file.read()
            if task.startswith("antmaze"):
                xml = antmaze_xml(xml)
        with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
            file.write(xml)
            file.flush()
            error = ctypes.create_string_buffer(500)
            self.m = ctypes.c_void_p(library.load(file.name.encode(), error))
            assert self.m.value, error.value
        self.d = ctypes.c_void_p(library.make(self.m))
        self.nq, self.nv, self.nu, nforce = [library.size(self.m, i) for i in range(4)]
        array = lambda pointer, n: np.ctypeslib.as_array(pointer, (n,))
        self.qpos, self.qvel, self.ctrl, self.xpos, self.cfrc = [
            array(library.of_data(self.d, i), n) for i, n in enumerate((self.nq, self.nv, self.nu, 6, nforce))]
        self.qpos0 = array(library.of_model(self.m, 0), self.nq).copy()
        self.range = array(library.of_model(self.m, 1), 2 * self.nu).reshape(-1, 2)
        self.timestep = array(library.of_model(self.m, 2), 1)[0]
        self.skip = {"hopper": 4, "walker2d": 4, "halfcheetah": 5, "ant": 5, "antmaze-umaze": 5}.get(task, 1)
        maze = MAPS.get(task, "").split()
        goals = [(i, j) for i, row in enumerate(maze) for j, c in enumerate(row) if c == "G"]
        self.goal = None if not goals else np.array(goals[0], dtype=float) if task.startswith("maze2d") else \
            4.0 * np.array([goals[0][1] - 1, goals[0][0] - 1])

    def start(self, qpos, qvel):
        self.c.reset(self.m, self.d)
        self.qpos[:], self.qvel[:] = qpos, qvel
        self.c.forward(self.m, self.d)

    def observe(self):
        t = self.task
        v = np.clip(self.qvel, -10, 10) if t in ("hopper", "walker2d") else self.qvel
        first = {"hopper": 1, "walker2d": 1, "halfcheetah": 1, "ant": 2}.get(t, 0)
        parts = [self.qpos[first:], v] + ([np.clip(self.cfrc, -1, 1)] if t == "ant" else [])
        return np.concatenate(parts)

    def step(self, action):
        """One action of a policy, in [-1, 1]: observation, reward, done."""
        t, (low, high) = self.task, self.range.T
        if t.startswith("maze2d"):
            a = np.clip(action, -1, 1)
            self.qvel[:] = np.clip(self.qvel, -5, 5)
            self.c.forward(self.m, self.d)
        else:
            a = np.clip(low + (np.asarray(action) + 1.0) * 0.5 * (high - low), low, high)
        before = self.xpos[3] if t == "ant" else self.qpos[0]
        self.ctrl[:] = a
        for _ in range(self.skip):
            self.c.step(self.m, self.d)
        q, v = self.qpos, self.qvel
        if self.goal is not None:
            there = math.dist(q[:2], self.goal) <= 0.5
            return self.observe(), float(there), there and t.startswith("antmaze")
        after = self.xpos[3] if t == "ant" else q[0]
        speed = (after - before) / (self.timestep * self.skip)
        finite = np.isfinite(q).all() and np.isfinite(v).all()
        if t == "hopper":
            rest = np.concatenate([q, v])[2:]
            return self.observe(), speed + 1 - 1e-3 * (a**2).sum(), not (
                finite and (np.abs(rest) < 100).all() and q[1] > 0.7 and abs(q[2]) < 0.2)
        if t == "walker2d":
            return self.observe(), speed + 1 - 1e-3 * (a**2).sum(), not (0.8 < q[1] < 2.0 and -1.0 < q[2] < 1.0)
        if t == "halfcheetah":
            return self.observe(), speed - 0.1 * (a**2).sum(), False
        contact = 0.5e-3 * (np.clip(self.cfrc, -1, 1)**2).sum()
        return self.observe(), speed + 1 - 0.5 * (a**2).sum() - contact, not (finite and 0.2 <= q[2] <= 1.0)


def environments():
    import ctypes
    import subprocess
    import tempfile
    folder = tempfile.mkdtemp()
    with open(folder + "/shim.c", "w") as file:
        file.write(SHIM)
    subprocess.run(["gcc", "-O1", "-shared", "-fPIC", folder + "/shim.c", "-o", folder + "/shim.so", "-lmujoco"],
                   check=True)
    library = ctypes.CDLL(folder + "/shim.so")
    for name in ("load", "make"):
        getattr(library, name).restype = ctypes.c_void_p
    for name in ("of_model", "of_data"):
        getattr(library, name).restype = ctypes.POINTER(ctypes.c_double)
    for task in ("hopper", "walker2d", "halfcheetah", "ant", "maze2d-umaze", "maze2d-medium", "maze2d-large",
                 "antmaze-umaze"):
        environment(Engine(task, library))


def environment(e):
    task, nq, nv, nu = e.task, e.nq, e.nv, e.nu
    f = File("env_" + task, "none: gym's and D4RL's task")
    source = "peer: libmujoco 2.2.2 driven from Python, gym's and D4RL's rules written again"
    near = "float64 1e-09, absolute 1e-09: the engine's arithmetic differs between processors in the last bits"

    def case(name, note, qpos, qvel, actions, expected=None, source_=source, tolerance=near, **more):
        """qpos [m, nq], ...; actions [m, A] or [m, T, A]. expected: what is known without the engine."""
        qpos, qvel, actions = np.atleast_2d(qpos), np.atleast_2d(qvel), np.asarray(actions, dtype=np.float64)
        several = actions.ndim == 3
        rows = []
        for q, v, a in zip(qpos, qvel, actions if several else actions[:, None]):
            e.start(q, v)
            for action in a:
                observation, reward, done = e.step(action)
                rows.append((e.qpos.copy(), e.qvel.copy(), observation, reward, done))
        outputs = {}
        for i, key in enumerate(("qpos", "qvel", "observation", "reward", "terminated")):
            x = np.array([row[i] for row in rows])
            outputs[key] = x.reshape(*actions.shape[:-1], *x.shape[1:]) if i < 3 else x.reshape(actions.shape[:-1])
        outputs["reward"] = outputs["reward"].astype(np.float64)
        outputs["terminated"] = outputs["terminated"].astype(np.int32)
        for key, x in (expected or {}).items():
            assert np.allclose(outputs[key], x, rtol=1e-9, atol=1e-9), (task, name, key, outputs[key], x)
            outputs[key] = np.array(x, dtype=outputs[key].dtype)
        f.case(name, note, tolerance, source_, dict({"qpos": qpos, "qvel": qvel, "actions": actions}, **more), outputs)

    if task.startswith("maze2d"):
        return maze2d(e, f, case)
    m = 4
    qpos = np.tile(e.qpos0, (m, 1)) + paint(3, m, nq) * 0.05
    qvel = paint(50, m, nv) * 0.5
    if task == "antmaze-umaze":
        e.goal = np.array([0.75, 8.5])
    goal = {} if e.goal is None else {"goal": e.goal.copy()}
    run = lambda *a, **k: case(*a, **dict(goal, **k))
    run("start", "at rest: the bonus alone, no velocity, no cost", e.qpos0, np.zeros(nv), np.zeros((1, nu)))
    run("moving", "order of actuators, of qpos and qvel; frame skip; cost of the action", qpos, qvel, paint(90, m, nu))
    run("actions_beyond", "an action beyond its bounds is the bound, in the actuator and in the cost",
        np.tile(qpos[:1], (2, 1)), np.tile(qvel[:1], (2, 1)), np.stack([np.full(nu, 1.5), np.full(nu, -4.0)]))
    limits = {"hopper": [3, 4, 5], "walker2d": [3, 4, 8], "halfcheetah": [3, 5, 8]}.get(task, [7, 8, 14])
    beyond = np.tile(qpos[:1], (len(limits), 1))
    for i, joint in enumerate(limits):
        beyond[i, joint] = e.qpos0[joint] + (2.0 if task == "halfcheetah" else 1.5)
    run("joint_limit", "a joint beyond its limit is pushed back", beyond, np.zeros((len(limits), nv)),
        np.zeros((len(limits), nu)))
    # Contact: fallen for a while under painted actions, then from there anew.
    states = []
    e.start(qpos[1], qvel[1] * 0.1)
    for i in range(40):
        e.step(paint(7 * i, nu))
        if i % 13 == 12:
            states.append((e.qpos.copy(), e.qvel.copy()))
    run("contact", "feet on the floor: friction, soft contact", [q for q, _ in states], [v for _, v in states],
        paint(33, len(states), nu))
    run("six_steps",
        "the control and the solver's warm start carry over; nothing is evaluated after the last engine step", qpos[:1],
        qvel[:1], paint(77, 1, 6, nu))
    fast = np.zeros(nv)
    fast[[1, nv - 1]] = [12.0, -25.0]
    run("fast", "velocities beyond 10: hopper's and walker2d's observation clips them, the others' does not", qpos[:1],
        fast, np.zeros((1, nu)))

    def threshold(name, note, index, start, inside, outside, velocity=False):
        """Finds by halving where the step's end crosses the threshold, and stands a millionth to either side."""
        q, v = e.qpos0.copy(), np.zeros(nv)
        if start is not None:
            q[:] = start

        def ends(x):
            q2, v2 = q.copy(), v.copy()
            (v2 if velocity else q2)[index] = x
            e.start(q2, v2)
            return e.step(np.zeros(nu))[2], q2, v2
        a, b = inside, outside
        assert not ends(a)[0] and ends(b)[0], (task, name)
        while abs(b - a) > 1e-9:
            a, b = ((a + b) / 2, b) if not ends((a + b) / 2)[0] else (a, (a + b) / 2)
        step = math.copysign(1e-6, outside - inside)
        sides = [ends(a - step), ends(b + step)]
        assert [s[0] for s in sides] == [False, True]
        run(name, note, [s[1] for s in sides], [s[2] for s in sides], np.zeros((2, nu)))

    if task == "hopper":
        air = e.qpos0 + [0, 2.0, 0, 0, 0, 0]
        bent = e.qpos0 + [0, -0.4, 0, -0.9, -1.4, 0.4]
        threshold("height", "done at z <= 0.7, just above and just below", 1, bent, 0.9, 0.6)
        threshold("pitch_up", "done at |pitch| >= 0.2", 2, air, 0.0, 0.5)
        threshold("pitch_down", "done at |pitch| >= 0.2, the other side", 2, air, 0.0, -0.5)
        threshold("speed", "done at a velocity of 100, unclipped", 5, air, 50.0, 250.0, True)
    elif task == "walker2d":
        air = e.qpos0 + [0, 0.4, 0, 0, 0, 0, 0, 0, 0]
        threshold("height_high", "done at z >= 2", 1, None, 1.5, 2.5)
        threshold("height_low", "done at z <= 0.8", 1, e.qpos0 + [0, 0, 0, -1.5, -2.0, 0, -1.5, -2.0, 0], 1.1, 0.6)
        threshold("pitch_up", "done at pitch >= 1", 2, air, 0.5, 1.5)
        threshold("pitch_down", "done at pitch <= -1", 2, air, -0.5, -1.5)
    elif task == "halfcheetah":
        over = e.qpos0.copy()
        over[2] = math.pi
        run("on_its_back", "never done", over, np.zeros(nv), np.zeros((1, nu)))
    elif task == "ant":
        threshold("height_high", "done at z > 1", 2, None, 0.9, 1.2)
        low = e.qpos0.copy()
        low[3:7] = [0, 1, 0, 0]  # on its back, pressed into the floor, which pushes it out
        threshold("height_low", "done at z < 0.2", 2, low, 0.1, -0.3)
        turned = np.tile(e.qpos0, (2, 1))
        turned[:, 3:7] = [[2.0, 0.0, 0.0, 0.0], [0.0, 3.0, 0.0, 4.0]]
        run("quaternion", "a quaternion of another length is normalised", turned, np.zeros((2, nv)), np.zeros((2, nu)))
    else:
        q = np.tile(e.qpos0, (3, 1))
        q[:, :2] = [[0.75, 8.5], [0.75 - 0.49, 8.5], [0.75 - 0.51, 8.5]]
        run("goal", "paid and over within half a metre of the goal", q, np.zeros((3, nv)), np.zeros((3, nu)),
            {"reward": [1, 1, 0], "terminated": [1, 1, 0]})
        q = np.tile(e.qpos0, (2, 1))
        q[:, 2] = [0.1, 1.5]
        run("fallen", "a fall ends nothing", q, np.zeros((2, nv)), np.zeros((2, nu)), {"terminated": [0, 0]})
        q = np.tile(e.qpos0, (2, 1))
        q[:, 0], q[:, 1] = [1.5, 5.5], [0.0, 8.0]
        run("walls", "a leg against a wall; columns are x, rows are y", q, np.zeros((2, nv)), paint(5, 2, nu))
    f.save()


def maze2d(e, f, case):
    """A ball of 4/3 pi 0.1^3 1000 kg, damping 1, pushed by 100 N, Euler with implicit damping."""
    mass, dt = 4 / 3 * math.pi * 0.1**3 * 1000, 0.01
    exact = CLOSED + ": v' = v + dt (100 a - v) / (mass + dt), x' = x + dt v'"
    goal = e.goal
    free = [(i, j) for i, row in enumerate(MAPS[e.task].split()) for j, c in enumerate(row) if c != "1"]
    m = 8
    qpos = np.array([free[k * len(free) // m] for k in range(m)]) + paint(3, m, 2) * 0.125 - 0.2
    qvel, actions = paint(50, m, 2), paint(90, m, 2)

    def moved(x, v, a):
        v = np.clip(v, -5, 5)
        v = v + dt * (100 * np.clip(a, -1, 1) - v) / (mass + dt)
        return x + dt * v, v

    def free_case(name, note, x, v, a, **expected):
        x1, v1 = moved(x, v, a)
        reward = (np.hypot(*(x1 - goal).T) <= 0.5).astype(float)
        case(
            name, note, x, v, a,
            dict(
                {
                    "qpos": x1, "qvel": v1, "observation": np.concatenate([x1, v1], 1), "reward": reward, "terminated":
                    np.zeros(len(x))}, **expected), exact,
            "float64 1e-09, absolute 1e-09: the engine's solver stops at 1e-8 of the constraint that the floor is")

    free_case("free", "free motion: damping, mass, order of x and y; no reward away from the goal", qpos, qvel, actions)
    free_case("velocity_clip", "velocities are clipped to 5 before the step, not after", qpos[:2],
              np.array([[8.0, -5.5], [-5.0, 6.0]]), np.array([[1.0, -1.0], [-1.0, 1.0]]))
    free_case("actions_beyond", "an action beyond its bounds is the bound", qpos[:2], qvel[:2],
              np.array([[3.0, -2.0], [-1.5, 1.0]]))
    away = np.array([0.0, 1.0] if e.task == "maze2d-umaze" else [0.0, -1.0])
    at = np.stack([goal + away * 0.4995, goal + away * 0.5005,
                   goal])  # of which the ball's wall may take it a little away
    case("goal", "1 within half a metre of the goal cell's indices, on the goal too, and the episode goes on", at,
         np.zeros((3, 2)), np.zeros((3, 2)), {"reward": [1, 0, 1], "terminated": np.zeros(3)})
    # Above and left of the first free cell stand walls.
    top = np.array(free[0]) - 0.2
    case("wall", "a wall: soft contact, at the place that the map says (1.2 off the indices)",
         [top + [-0.4, 0.0], top + [0.0, -0.4]], np.array([[-2.0, 0.5], [0.5, -2.0]]),
         np.array([[[-1.0, 0.25]] * 6, [[0.25, -1.0]] * 6]))
    f.save()


TOPICS = [rng, initialisation, returns, linear, layernorm, mlp, attention, tokens, policy_gaussian, policy_discrete,
          policy_deterministic, acting, memory_update, memory_lookup, memory_action, weights, objective, optimizer,
          sampling, normalize, gridworld, step, run, environments]

if __name__ == "__main__":
    for make in TOPICS:
        if len(sys.argv) == 1 or make.__name__ in sys.argv[1:]:
            make()
