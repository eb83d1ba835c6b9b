// One world is the work of LANES threads, in memory that they share: of a warp on a GPU, of a single thread on a CPU.
#if defined(__CUDA_ARCH__)
constexpr int LANES = $warp;
const int lane = threadIdx.x % LANES;
__shared__ float pool[$worlds * $words];
float* memory = pool + threadIdx.x / LANES * $words;
auto sync = [] { __syncwarp(); };
auto total = [](float x) {
    for (int k = LANES / 2; k > 0; k /= 2) x += __shfl_xor_sync(0xffffffffu, x, k);
    return x;
};
#else
constexpr int LANES = 1;
const int lane = 0;
float memory[$words];
auto sync = [] {};
auto total = [](float x) { return x; };
#endif
const int world = thread / LANES;
