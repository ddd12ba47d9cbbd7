// plain.hpp: plain definitions of products of matrices, of attention and of e-hat. The tests hold to them the fast or exact
// forms, which training runs; `wodtem check`, which also computes in double, does so with these.
#pragma once

#include "../memory.hpp"

// C [M, N] = or += A [M, K] B [K, N], in the order of additions that nn.hpp states at sum_block.
template <class T>
void matmul_plain(View<T> c, View<const T> a, View<const T> b, int M, int N, int K, Store store) {
    for (int i = 0; i < M; ++i)
        for (int j = 0; j < N; ++j) {
            if (store == Store::overwrite) c(i, j) = 0;
            for (int first = 0; first < K; first += sum_block) {
                T sum = 0;
                for (int k = first; k < std::min(K, first + sum_block); ++k) sum += a(i, k) * b(k, j);
                c(i, j) += sum;
            }
        }
}

// What nn.hpp's operations call where they are compiled for double: an overload of its matmul.
inline void matmul(Compute& compute, View<double> c, View<const double> a, View<const double> b, int M, int N, int K,
                   Store store, Epilogue<double> epilogue = {}) {
    compute.threads.run(M, [&](int i, int) {
        matmul_plain<double>({&c(i, 0), c.stride}, {&a(i, 0), a.stride, a.transposed}, b, 1, N, K, store);
    });
    apply_epilogue(c, epilogue, {0, M, 0, N});
}

// Causal attention, one head: out [n, d] = softmax over keys j <= i of (q_i . k_j / sqrt(d)), times v_j.
// q, k, v [n, d] of one sequence.
template <class T>
void attention_plain(T* out, const T* q, const T* k, const T* v, int n, int d) {
    std::vector<T> weight(n);
    for (int i = 0; i < n; ++i) {
        T total = 0;
        for (int j = 0; j <= i; ++j) {
            T score = 0;
            for (int c = 0; c < d; ++c) score += q[i * d + c] * k[j * d + c];
            weight[j] = std::exp(score / std::sqrt(T(d)));
            total += weight[j];
        }
        for (int c = 0; c < d; ++c) {
            out[i * d + c] = 0;
            for (int j = 0; j <= i; ++j) out[i * d + c] += weight[j] / total * v[j * d + c];
        }
    }
}

// e-hat(s_q) = sum_k p_k e_k, eq. (5) as the paper writes it, of K(s_q); NaN, that is unknown, for an empty one.
// Training compares by is_optimal(), which does not form it.
inline double approximate_return(const EpisodicMemory& memory, std::span<const Neighbour> found) {
    double sum = 0.0, normaliser = 0.0;
    for (size_t k = 0; k < found.size(); ++k) {
        sum += memory.similarity(found, k) * memory.e[found[k].entry];
        normaliser += memory.similarity(found, k);
    }
    return sum / normaliser;
}
