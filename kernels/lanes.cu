// One world is the work of LANES threads, in memory that they share: of some of a warp on a GPU, of a single one on a CPU.
#if defined(__CUDA_ARCH__)
constexpr int LANES = $lanes;
const int lane = threadIdx.x % LANES;
const unsigned us = LANES == 32 ? 0xffffffffu : (0xffffffffu >> (32 - LANES)) << (threadIdx.x - lane);
__shared__ alignas(16) float pool[$worlds * $words];
float* memory = pool + threadIdx.x / LANES * $words;
auto sync = [&] { __syncwarp(us); };
auto from = [&](float x, int k) { return __shfl_sync(us, x, k, LANES); };  // that of lane k
// The same bits in all lanes: an addition that is fused with a product would be rounded in one lane otherwise than in another.
auto total = [&](float x) {
    for (int k = LANES / 2; k > 0; k /= 2) x = __fadd_rn(x, __shfl_xor_sync(us, x, k));
    return x;
};
#else
constexpr int LANES = 1;
const int lane = 0;
alignas(16) float memory[$words];
auto sync = [] {};
auto from = [](float x, int) { return x; };
auto total = [](float x) { return x; };
#endif
const int world = thread / LANES;
if (robots.parked.data[world] == 2) return;
constexpr int ALL = LANES == 1 ? 1 : 64;  // loops over registers are unrolled, those of a CPU over memory are not
auto of_model = [&](const auto& array, int k) -> const auto& { return wp::index(array, world % array.shape[0], k); };
