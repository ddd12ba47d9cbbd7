#!/usr/bin/env python3
"""How long PyTorch takes for what `./wodtem bench` calls an update. Nothing runs this file: no build, no test.

    taskset -c 1 python3 tests/peer_speed.py --threads 1     # BENCH.md says how to install PyTorch

An update is: forward, eqs. (8) to (10), backward, clipping, LAMB, a step of lambda; ours also draws the batch and asks
the memory. In fp32, and under bf16 autocast; two variants compute the same:
"as written": attention by its equation, all positions through all layers, LAMB by its formula, tensor by tensor;
"best found": scaled_dot_product_attention, foreach LAMB, the batch in parts, no token for a window's last action, and
after the last layer's keys and values only states go on. Windows are full, as nearly all of halfcheetah's are: no
padding, and packing changes nothing. Tokens enter the first layer: 3 K a window as written, 3 K - 1 best found, as in
ours. Written from README.md, nn.hpp and PORTING.md; it makes the updates of step.safetensors (BENCH.md)."""
import argparse
import math
import statistics
import time

import torch
from torch import nn
from torch.nn import functional as F

BATCH, DROPOUT, WIDTH = 256, 0.1, 512
CLIP_NORM, WARMUP, BETA_1, BETA_2, EPSILON = 0.25, 10000, 0.9, 0.999, 1e-8
# The sizes of `./wodtem bench`. actions: dimensions or one-hot moves. K: context length. parts: of a batch, best found.
NETWORKS = {
    "gridworld": dict(states=2, actions=4, layers=1, heads=1, K=1, lr=1e-3, decay=0, eta=-1, one_hot=1, parts=1),
    "halfcheetah": dict(states=17, actions=6, layers=4, heads=4, K=20, lr=1e-4, decay=5e-4, eta=-6, one_hot=0, parts=8),
}
ALL, STATES = slice(None), slice(1, None, 3)  # which tokens of R_1 s_1 a_1 R_2 s_2 a_2 ...


class Block(nn.Module):
    """x1 = x + attention(LN(x)), then x1 + MLP(LN(x1)). x [windows, tokens, width] -> [windows, rows, width]."""

    def __init__(self, heads):
        super().__init__()
        self.heads = heads
        self.ln_1, self.ln_2 = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH)
        self.c_attn, self.attn_proj = nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(WIDTH, WIDTH)
        self.c_fc, self.mlp_proj = nn.Linear(WIDTH, 4 * WIDTH), nn.Linear(4 * WIDTH, WIDTH)

    def forward(self, x, rows, dropout, best):
        h, tokens = self.ln_1(x), torch.arange(x.shape[1])
        if rows == ALL:
            q, k, v = self.c_attn(h).chunk(3, 2)
        else:  # queries of the tokens that go on, keys and values of all
            weight, bias = self.c_attn.weight, self.c_attn.bias
            q = F.linear(h[:, rows], weight[:WIDTH], bias[:WIDTH])
            k, v = F.linear(h, weight[WIDTH:], bias[WIDTH:]).chunk(2, 2)
        q, k, v = (y.unflatten(2, (self.heads, -1)).transpose(1, 2) for y in (q, k, v))
        sees = tokens[rows, None] >= tokens  # [rows, tokens]
        if best:
            a = F.scaled_dot_product_attention(q, k, v, attn_mask=sees, dropout_p=dropout)
        else:
            scores = (q @ k.transpose(2, 3) / math.sqrt(q.shape[3])).masked_fill(~sees, -math.inf)
            a = F.dropout(scores.softmax(3), dropout) @ v
        x = x[:, rows] + F.dropout(self.attn_proj(a.transpose(1, 2).flatten(2)), dropout)
        return x + F.dropout(self.mlp_proj(F.relu(self.c_fc(self.ln_2(x)))), dropout)


class Transformer(nn.Module):
    def __init__(self, network):
        super().__init__()
        self.embed_return, self.embed_state = nn.Linear(1, WIDTH), nn.Linear(network["states"], WIDTH)
        self.embed_action, self.embed_ln = nn.Linear(network["actions"], WIDTH), nn.LayerNorm(WIDTH)
        self.blocks = nn.ModuleList(Block(network["heads"]) for _ in range(network["layers"]))
        self.ln_f = nn.LayerNorm(WIDTH)  # and the heads: logits, or mean and log-std
        self.heads = nn.ModuleList(nn.Linear(WIDTH, network["actions"]) for _ in range(2 - network["one_hot"]))

    def forward(self, returns, states, actions, dropout, best):
        x = torch.stack([self.embed_return(returns), self.embed_state(states), self.embed_action(actions)], 2)
        x = F.dropout(self.embed_ln(x.flatten(1, 2)[:, : -1 if best else None]), dropout)
        for block in self.blocks:
            x = block(x, STATES if best and block is self.blocks[-1] else ALL, dropout, best)
        x = self.ln_f(x)
        return [head(x if best else x[:, STATES]).float() for head in self.heads]


def log_density(mean, log_std, u):
    """log pi(tanh(u)) of u ~ N(mean, exp(log_std)^2), summed over dimensions; slope is log(1 - tanh(u)^2)."""
    slope = 2 * (math.log(2) - u - F.softplus(-2 * u))
    return (-0.5 * ((u - mean) / log_std.exp()) ** 2 - log_std - 0.5 * math.log(2 * math.pi) - slope).sum(2)


class Learner:
    def __init__(self, network, best, bf16, windows=BATCH, dropout=DROPOUT):
        torch.manual_seed(0)
        self.network, self.best, self.bf16, self.dropout = network, best, bf16, dropout
        self.model, self.parts, self.updates, self.times = Transformer(network), network["parts"] if best else 1, 0, []
        self.parameters = list(self.model.parameters())
        self.m, self.v = ([torch.zeros_like(p) for p in self.parameters] for _ in range(2))
        self.log_lambda = nn.Parameter(torch.tensor(math.log(0.1)))
        self.adam = torch.optim.Adam([self.log_lambda], lr=1e-4)
        shape, count = (windows, network["K"]), network["actions"]
        actions, advised, noise = torch.randn(3, *shape, count)
        kind = (lambda x: F.one_hot(x.argmax(2), count).float()) if network["one_hot"] else torch.tanh
        returns, states, w = torch.randn(*shape, 1), torch.randn(*shape, network["states"]), torch.full(shape, 0.9)
        self.batch = [returns, states, kind(actions), kind(advised), noise, w]

    def update(self):
        steps, mean_entropy, lambda_now = self.batch[-1].numel(), 0.0, self.log_lambda.detach().exp()
        for returns, states, actions, advised, noise, w in zip(*(x.chunk(self.parts) for x in self.batch)):
            with torch.autocast("cpu", torch.bfloat16, enabled=self.bf16):
                heads = self.model(returns, states, actions, self.dropout, self.best)
            if self.network["one_hot"]:
                log_p = heads[0].log_softmax(2)
                of_actions, of_advised, entropy = ((log_p * x).sum(2) for x in (actions, advised, -log_p.exp()))
            else:
                mean, log_std = heads[0], -5 + 3.5 * (heads[1].tanh() + 1)
                of_actions, of_advised = (log_density(mean, log_std, a.atanh()) for a in (actions, advised))
                entropy = -log_density(mean, log_std, mean + log_std.exp() * noise)
            H, L = entropy.sum() / steps, -(w * of_actions + (1 - w) * of_advised).sum() / steps
            (L - lambda_now * H).backward()
            mean_entropy += H.detach()
        nn.utils.clip_grad_norm_(self.parameters, CLIP_NORM, foreach=self.best)
        self.lamb()
        self.model.zero_grad()
        self.log_lambda.grad = lambda_now * (mean_entropy - self.network["eta"])
        self.adam.step()

    @torch.no_grad()
    def lamb(self):
        """The trust ratio |p| / |u| is left out at weight decay 0, as in ODT's."""
        self.updates += 1
        rate, decay = self.network["lr"] * min(self.updates / WARMUP, 1), self.network["decay"]
        bias_1, bias_2 = 1 - BETA_1**self.updates, 1 - BETA_2**self.updates
        if not self.best:
            for p, m, v in zip(self.parameters, self.m, self.v):
                m.copy_(BETA_1 * m + (1 - BETA_1) * p.grad)
                v.copy_(BETA_2 * v + (1 - BETA_2) * p.grad**2)
                u = m / bias_1 / ((v / bias_2).sqrt() + EPSILON) + decay * p
                p.sub_(rate * (p.norm() / u.norm() if decay and p.norm() * u.norm() > 0 else 1.0) * u)
            return
        p, m, v, g = self.parameters, self.m, self.v, [p.grad for p in self.parameters]
        torch._foreach_lerp_(m, g, 1 - BETA_1)
        torch._foreach_mul_(v, BETA_2)
        torch._foreach_addcmul_(v, g, g, 1 - BETA_2)
        u = torch._foreach_sqrt(v)
        torch._foreach_mul_(u, bias_1 / math.sqrt(bias_2))
        torch._foreach_add_(u, bias_1 * EPSILON)
        u = torch._foreach_div(m, u)
        if decay:
            torch._foreach_add_(u, p, alpha=decay)
            norms = zip(torch._foreach_norm(p), torch._foreach_norm(u))
            torch._foreach_mul_(u, [n / s if n * s > 0 else torch.ones(()) for n, s in norms])
        torch._foreach_add_(p, u, alpha=-rate)


def check(network):
    """Without dropout, warming up in three updates, both variants change the weights alike, within 1%. 16 windows."""
    network = dict(network, lr=network["lr"] * WARMUP / 3)
    plain, best = (Learner(network, best, False, 16, 0.0) for best in (False, True))
    start = nn.utils.parameters_to_vector(plain.parameters).detach()
    for learner in 3 * [plain, best]:
        learner.update()
    end, best_end = (nn.utils.parameters_to_vector(learner.parameters) for learner in (plain, best))
    assert (end - best_end).norm() < 0.01 * (end - start).norm() and plain.log_lambda.isclose(best.log_lambda)


if __name__ == "__main__":
    options = argparse.ArgumentParser()
    options.add_argument("--threads", type=int, default=1)
    options.add_argument("--rounds", type=int, default=3, help="updates of each kind; grid world: ten times it")
    options.add_argument("--network", choices=NETWORKS, help="this one alone")
    options = options.parse_args()
    torch.set_num_threads(options.threads)
    print(f"torch {torch.__version__}, batch {BATCH}, full windows; medians; processor seconds: of all threads.\n")
    print("| network | precision | variant | tokens | threads | seconds | processor seconds |\n|" + " --- |" * 7)
    for name in [options.network] if options.network else NETWORKS:
        check(network := NETWORKS[name])
        learners = [Learner(network, best, bf16) for bf16 in (False, True) for best in (False, True)]
        for round in range(1 + options.rounds * (10 if name == "gridworld" else 1)):  # in turns
            for learner in learners:
                wall, processor = time.perf_counter(), time.process_time()
                learner.update()
                learner.times.append((time.perf_counter() - wall, time.process_time() - processor))
        for one in learners:
            seconds = " | ".join(f"{statistics.median(x):.4f}" for x in zip(*one.times[1:]))  # the first does not count
            print(f"| {name} | {'bf16' if one.bf16 else 'fp32'} | {'best found' if one.best else 'as written'} "
                  f"| {BATCH * (3 * network['K'] - one.best)} | {options.threads} | {seconds} |", flush=True)
