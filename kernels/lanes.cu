// LANES threads work on one world and share its memory: a part of a warp on a GPU, one thread on a CPU.
#if defined(__CUDA_ARCH__)
constexpr int LANES = $lanes;
const int lane = threadIdx.x % LANES;
const unsigned lanes_mask = LANES == 32 ? 0xffffffffu : (0xffffffffu >> (32 - LANES)) << (threadIdx.x - lane);
__shared__ alignas(16) float pool[$worlds * $num_floats];
float* memory = pool + threadIdx.x / LANES * $num_floats;
auto sync = [&] { __syncwarp(lanes_mask); };
auto shuffle = [&](auto x, int k) { return __shfl_sync(lanes_mask, x, k, LANES); };  // the x of lane k
// Sums over the lanes of several numbers at once, so that none waits for another. The same bits in all lanes: a fused
// multiply-add would round differently from lane to lane.
auto add_lanes = [&](auto&... x) {
    for (int k = LANES / 2; k > 0; k /= 2) ((x = __fadd_rn(x, __shfl_xor_sync(lanes_mask, x, k))), ...);
};
auto find_sine = [](float x, float& sine, float& cosine) { sincosf(x, &sine, &cosine); };
#else
constexpr int LANES = 1;
const int lane = 0;
alignas(16) float memory[$num_floats];
auto sync = [] {};
auto shuffle = [](auto x, int) { return x; };
auto add_lanes = [](auto&...) {};
auto find_sine = [](float x, float& sine, float& cosine) {
    sine = wp::sin(x);
    cosine = wp::cos(x);
};
#endif
const int world = thread / LANES;
if (robots.parked.data[world] == 2) return;
constexpr int ALL = LANES == 1 ? 1 : 64;  // a GPU unrolls loops over registers; a CPU does not
auto row_of = [&](const auto& array) { return array.shape[0] == 1 ? 0 : world; };  // one row for all worlds, or a row for each
auto model_value = [&](const auto& array, int k) -> const auto& { return wp::index(array, row_of(array), k); };
