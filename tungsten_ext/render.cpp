// The hook: Tungsten's scene, integrator and camera behind render.hpp.
#include "render.hpp"

#include <rapidjson/stringbuffer.h>
#include <rapidjson/writer.h>
#include <sys/mman.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <future>
#include <map>
#include <mutex>
#include <new>
#include <sstream>
#include <stdexcept>
#include <streambuf>
#include <thread>
#include <utility>

#include "Version.hpp"
#include "cameras/Camera.hpp"
#include "cameras/OutputBuffer.hpp"
#include "integrators/path_tracer/PathTraceIntegrator.hpp"
#include "io/DirectoryChange.hpp"
#include "io/FileUtils.hpp"
#include "io/JsonDocument.hpp"
#include "io/Scene.hpp"
#include "io/StringUtils.hpp"
#include "math/BitManip.hpp"
#include "primitives/EmbreeUtil.hpp"
#include "renderer/TraceableScene.hpp"
#include "thread/ThreadPool.hpp"
#include "thread/ThreadUtils.hpp"
#ifdef OPENVDB_AVAILABLE
#include <openvdb/openvdb.h>
#endif

namespace tungsten_dip {

using namespace Tungsten;

namespace {

constexpr std::uint32_t stock_seed = 0xBA5EBA11;

// Tungsten's pools detach their workers when destroyed, which then read freed memory: a pool is kept for good
// instead.
void use_threads(int requested) {
    static std::map<std::uint32_t, ThreadPool*> pools;
    const std::uint32_t threads = requested > 0 ? static_cast<std::uint32_t>(requested)
                                                : std::max(ThreadUtils::idealThreadCount() - 1, 1u);
    ThreadPool*& pool = pools[threads];
    if (!pool) {
        ThreadUtils::startThreads(static_cast<int>(threads));
        pool = ThreadUtils::pool;
    }
    ThreadUtils::pool = pool;
}

void initialize_libraries() {
    static std::once_flag once;
    std::call_once(once, [] {
        EmbreeUtil::initDevice();
#ifdef OPENVDB_AVAILABLE
        openvdb::initialize();
#endif
    });
}

std::string one_line(std::string text) {
    for (std::string::size_type at; (at = text.find('\n')) != std::string::npos;) {
        const auto next = text.find_first_not_of(" \n", at);
        text.replace(at, next == std::string::npos ? std::string::npos : next - at,
                     next == std::string::npos ? "" : " ");
    }
    return text;
}

// A derived class may name the camera's protected members: the way to own a buffer that outlives its scene.
struct CameraBuffers : Camera {
    static constexpr auto color = &CameraBuffers::_colorBuffer;
    static constexpr auto albedo = &CameraBuffers::_albedoBuffer;
    static constexpr auto normal = &CameraBuffers::_normalBuffer;
    static constexpr auto depth = &CameraBuffers::_depthBuffer;
    static constexpr auto visibility = &CameraBuffers::_visibilityBuffer;
};

// What Integrator::resumeRender needs of itself, for our own reading of what it saves.
struct IntegratorState : Integrator {
    static constexpr auto load = &IntegratorState::loadState;
    static constexpr auto current_spp = &IntegratorState::_currentSpp;
    static constexpr auto advance_spp = &IntegratorState::advanceSpp;
};

// Calls f(type, name, member) for every quantity, colour first.
template <typename F>
void for_each_quantity(F&& f) {
    f(OutputColor, "color", CameraBuffers::color);
    f(OutputAlbedo, "albedo", CameraBuffers::albedo);
    f(OutputNormal, "normal", CameraBuffers::normal);
    f(OutputDepth, "depth", CameraBuffers::depth);
    f(OutputVisibility, "visibility", CameraBuffers::visibility);
}

// OutputBuffer::serialize writes half A, half B, the summed squared deviations and the sample counts, each as
// one block. This stream notes where the blocks lie and copies nothing.
class BlockAddresses : public std::streambuf {
  public:
    std::vector<const char*> blocks;

  protected:
    std::streamsize xsputn(const char* data, std::streamsize size) override {
        blocks.push_back(data);
        return size;
    }
};

struct BufferBlocks {
    const float* half_a;
    const float* half_b;
    const float* squared_deviations;
    const std::uint32_t* counts;
};

// Only for buffers with halves and variance, which is what Render asks for.
template <typename T>
BufferBlocks blocks_of(const OutputBuffer<T>& buffer) {
    static_assert(sizeof(Vec3f) == 3 * sizeof(float));
    BlockAddresses addresses;
    OutputStreamHandle stream = std::make_shared<std::ostream>(&addresses);
    buffer.serialize(stream);
    if (addresses.blocks.size() != 4)
        throw std::runtime_error(
            "expected output buffers with halves and variance; this Tungsten keeps others");
    const auto floats = [&](std::size_t i) { return reinterpret_cast<const float*>(addresses.blocks[i]); };
    return {floats(0), floats(1), floats(2), reinterpret_cast<const std::uint32_t*>(addresses.blocks[3])};
}

// For all pixels in [begin, end): the mean of both halves, and, in place, the variance of that mean from the
// summed squared deviations. Both as OutputBuffer has them, but in runs of equal sample counts, which the
// compiler can vectorise. A pixel without samples gets 0 where OutputBuffer::save writes a variance of 0/0.
void combine(const BufferBlocks& blocks, std::size_t channels, std::uint32_t begin, std::uint32_t end,
             float* __restrict mean, float* __restrict variance) {
    while (begin < end) {
        const std::uint32_t count = blocks.counts[begin];
        const std::uint32_t* run_end = std::find_if(blocks.counts + begin, blocks.counts + end,
                                                    [=](std::uint32_t c) { return c != count; });
        const auto stop = static_cast<std::uint32_t>(run_end - blocks.counts);
        const float count_a = static_cast<float>((count + 1) / 2), count_b = static_cast<float>(count / 2);
        const float n = static_cast<float>(std::max(count, 1u));
        const float degrees = std::max(1.0f, n * (n - 1.0f));
        for (std::size_t i = begin * channels; i < stop * channels; ++i) {
            mean[i] = (blocks.half_a[i] * count_a + blocks.half_b[i] * count_b) / n;
            variance[i] /= degrees;
        }
        begin = stop;
    }
}

// Calls f(begin, end) for a share of the items on every core. Tungsten's own parallelFor looks for the end of
// the work only every 10 ms, which is a fifth of what a hand-over may take.
template <typename F>
void parallel_ranges(std::uint32_t items, const F& f) {
    const std::uint32_t shares = std::max(1u, std::thread::hardware_concurrency());
    std::vector<std::jthread> threads;
    for (std::uint64_t share = 0; share < shares; ++share)
        threads.emplace_back(f, static_cast<std::uint32_t>(items * share / shares),
                             static_cast<std::uint32_t>(items * (share + 1) / shares));
}

// Owns what an Evidence points into: buffers moved out of the camera, and arrays of our own.
class EvidenceMemory {
  public:
    // Large pages: writing to 90 MB of new memory for the first time otherwise takes longer than all else.
    float* allocate(std::size_t floats) {
        constexpr std::size_t large_page = std::size_t{2} << 20;
        const std::size_t bytes = (floats * sizeof(float) + large_page - 1) / large_page * large_page;
        void* memory = std::aligned_alloc(large_page, bytes);
        if (!memory) throw std::bad_alloc();
        arrays_.emplace_back(memory, std::free);
        madvise(memory, bytes, MADV_HUGEPAGE);
        return static_cast<float*>(memory);
    }

    float* copy(const float* source, std::size_t floats) {
        float* array = allocate(floats);
        std::memcpy(array, source, floats * sizeof(float));
        return array;
    }

    template <typename T>
    void own(std::unique_ptr<OutputBuffer<T>> buffer) {
        buffers_.emplace_back(std::move(buffer));
    }

  private:
    std::vector<std::shared_ptr<void>> buffers_;
    std::vector<std::unique_ptr<void, decltype(&std::free)>> arrays_;
};

bool has_complete_output(const RendererSettings& settings, int type) {
    bool complete = false;
    for (const OutputBufferSettings& output : settings.renderOutputs())
        if (output.type() == type) complete = output.twoBufferVariance() && output.sampleVariance();
    return complete;
}

// A state saved with other buffers cannot be read back, so renders with evidence keep their own.
std::string resume_file_with_evidence(const std::string& path) {
    const auto dot = path.find_last_of("./\\");
    const bool has_extension = dot != std::string::npos && path[dot] == '.';
    return has_extension ? path.substr(0, dot) + "_dip" + path.substr(dot) : path + "_dip";
}

// Of everything but the renderer's settings, as a saved state carries it.
uint64 scene_hash(const Scene& scene) {
    rapidjson::Document document;
    document.SetObject();
    static_cast<rapidjson::Value&>(document) = scene.toJson(document.GetAllocator());
    document.RemoveMember("renderer");
    rapidjson::StringBuffer text;
    rapidjson::Writer<rapidjson::StringBuffer> writer(text);
    document.Accept(writer);
    return BitManip::hash(text.GetString());
}

// The settings' own reader takes our additions as if they stood in the scene file. Fields that are not named
// stay.
void ask_for_evidence(Scene& scene, bool writes_features) {
    RendererSettings& settings = scene.rendererSettings();
    rapidjson::Document additions;
    additions.SetObject();
    auto& allocator = additions.GetAllocator();
    // Even and odd Sobol points mirror each other, so the halves would not be independent.
    additions.AddMember("stratified_sampler", false, allocator);
    const std::string resume_file = resume_file_with_evidence(settings.resumeRenderFile().asString());
    additions.AddMember("resume_render_file", rapidjson::Value(resume_file.c_str(), allocator), allocator);
    rapidjson::Value outputs(rapidjson::kArrayType);
    for_each_quantity([&](OutputBufferTypeEnum type, const char* name, auto) {
        if ((type != OutputColor && !writes_features) || has_complete_output(settings, type)) return;
        rapidjson::Value output(rapidjson::kObjectType);
        output.AddMember("type", rapidjson::Value(name, allocator), allocator);
        output.AddMember("two_buffer_variance", true, allocator);
        output.AddMember("sample_variance", true, allocator);
        outputs.PushBack(output, allocator);
    });
    additions.AddMember("output_buffers", outputs, allocator);
    settings.fromJson(JsonDocument(scene.path(), JsonUtils::jsonToString(additions)), scene);
}

std::string absolute_name(const Path& path) {
    return path.empty() ? std::string() : path.absolute().asString();
}

Path absolute_folder(const std::string& folder) {
    Path path(folder);
    path.freezeWorkingDirectory();
    return path.absolute();
}

Path frozen(const std::string& file) {
    Path path(file);
    path.freezeWorkingDirectory();
    return path;
}

}  // namespace

struct Render::Impl {
    Path input_directory;
    std::unique_ptr<Scene> scene;
    // Of the scene's file and without halves or variance: rendered with both, saved without (save_as_asked).
    std::map<int, OutputBufferSettings> incomplete_outputs;
    std::unique_ptr<TraceableScene> traceable;
    std::future<void> pass;
    RenderPlan plan;
    std::uint32_t total_spp;

    Integrator& integrator() const {
        if (!traceable) throw std::runtime_error("this render is over: its buffers were taken");
        return traceable->integrator();
    }

    Evidence collect(EvidenceMemory& memory, bool take) const;
    template <typename T>
    void save_as_asked(const OutputBuffer<T>& buffer, const OutputBufferSettings& settings) const;
};

Render::Render(const std::string& scene_path, const RenderOptions& options) : impl_(new Impl) {
    initialize_libraries();
    use_threads(options.threads);
    // Tungsten keeps its own idea of the current folder, from when the process started.
    std::error_code ignored;
    FileUtils::changeCurrentDir(Path(std::filesystem::current_path(ignored).string()));

    Impl& self = *impl_;
    const Path path(scene_path);
    self.input_directory =
        options.input_directory.empty() ? path.parent() : absolute_folder(options.input_directory);
    try {
        self.scene.reset(Scene::load(path, nullptr, &self.input_directory));
        self.scene->loadResources();
    } catch (const std::exception& error) {
        throw std::runtime_error(one_line(error.what()));
    }

    RendererSettings& settings = self.scene->rendererSettings();
    if (options.spp) settings.setSpp(*options.spp);
    if (!options.output_file.empty()) settings.setOutputFile(frozen(options.output_file));
    if (!options.hdr_output_file.empty()) settings.setHdrOutputFile(frozen(options.hdr_output_file));
    const std::optional<Path> output_directory =
        options.output_directory.empty() ? std::nullopt
                                         : std::optional(absolute_folder(options.output_directory));
    if (output_directory && !output_directory->exists()) FileUtils::createDirectory(*output_directory, true);

    const DirectoryChange context(self.input_directory);
    const bool writes_features = dynamic_cast<PathTraceIntegrator*>(self.scene->integrator()) != nullptr;
    const std::size_t own_outputs = settings.renderOutputs().size();
    ask_for_evidence(*self.scene, writes_features);
    if (output_directory) settings.setOutputDirectory(*output_directory);
    for (std::size_t i = 0; i < own_outputs; ++i) {  // a later entry replaces an earlier one, as in Tungsten
        const OutputBufferSettings& output = settings.renderOutputs()[i];
        self.incomplete_outputs.erase(output.type());
        if (!output.twoBufferVariance() || !output.sampleVariance())
            self.incomplete_outputs.emplace(output.type(), output);
    }

    const std::uint32_t seed = options.seed.value_or(stock_seed);
    self.traceable.reset(self.scene->makeTraceable(seed));
    self.total_spp = settings.spp();
    rapidjson::Document document;
    self.plan = RenderPlan{
        .integrator = self.scene->integrator()->toJson(document.GetAllocator())["type"].GetString(),
        .tonemap = self.scene->camera()->tonemapOp().toString(),
        .output_file = absolute_name(settings.outputFile()),
        .hdr_output_file = absolute_name(settings.hdrOutputFile()),
        .checkpoint_interval_s = StringUtils::parseDuration(settings.checkpointInterval()),
        .timeout_s = StringUtils::parseDuration(settings.timeout()),
        .resume = settings.enableResumeRender() && self.integrator().supportsResumeRender(),
        .writes_features = writes_features,
        .seed = seed,
    };
}

Render::~Render() {
    if (impl_->pass.valid()) impl_->pass.wait();
}

const RenderPlan& Render::plan() const { return impl_->plan; }
std::uint32_t Render::current_spp() const { return impl_->integrator().currentSpp(); }
std::uint32_t Render::total_spp() const { return impl_->total_spp; }
bool Render::done() const { return impl_->integrator().done(); }

// Reads what Integrator::saveRenderResumeData wrote. Its counterpart resumeRender keeps a reference to a path
// that no longer exists when it opens the file, so with many compilers it never resumes.
bool Render::resume() {
    Scene& scene = *impl_->scene;
    Integrator& integrator = impl_->integrator();
    const RendererSettings& settings = scene.rendererSettings();
    const Path& file = settings.resumeRenderFile();
    InputStreamHandle in = FileUtils::openInputStream(file);
    if (!in) return false;

    const JsonDocument document(file, FileUtils::streamRead<std::string>(in));
    bool adaptive = false, stratified = false;
    uint32 spp = 0;
    if (!document.getField("adaptive_sampling", adaptive) || adaptive != settings.useAdaptiveSampling() ||
        !document.getField("stratified_sampler", stratified) || stratified != settings.useSobol() ||
        !document.getField("current_spp", spp))
        return false;
    if (FileUtils::streamRead<uint64>(in) != scene_hash(scene)) return false;

    scene.camera()->deserializeOutputBuffers(in);
    (integrator.*IntegratorState::load)(in);
    if (!in->good()) throw std::runtime_error(file.absolute().asString() + " is cut short");
    integrator.*IntegratorState::current_spp = spp;
    (integrator.*IntegratorState::advance_spp)();
    return true;
}

void Render::start_pass() {
    Integrator& integrator = impl_->integrator();
    integrator.startRender([] {});
    impl_->pass = std::async(std::launch::async, [&integrator] { integrator.waitForCompletion(); });
}

bool Render::wait_for_pass(std::chrono::milliseconds at_most) {
    if (impl_->pass.wait_for(at_most) != std::future_status::ready) return false;
    impl_->pass.get();
    return true;
}

void Render::save_checkpoint() {
    const DirectoryChange context(impl_->input_directory);
    impl_->integrator().saveCheckpoint();
    if (impl_->plan.resume) impl_->integrator().saveRenderResumeData(*impl_->scene);
}

void Render::save_outputs() {
    const DirectoryChange context(impl_->input_directory);
    Integrator& integrator = impl_->integrator();
    integrator.saveOutputs();
    if (impl_->plan.resume) integrator.saveRenderResumeData(*impl_->scene);
    for_each_quantity([&](OutputBufferTypeEnum type, const char*, auto member) {
        const auto own = impl_->incomplete_outputs.find(type);
        const auto& buffer = (*impl_->scene->camera()).*member;
        if (own != impl_->incomplete_outputs.end() && buffer) impl_->save_as_asked(*buffer, own->second);
    });
}

// Reads our buffer's samples into one with the scene's own settings, which then writes its files as stock
// would.
template <typename T>
void Render::Impl::save_as_asked(const OutputBuffer<T>& buffer, const OutputBufferSettings& settings) const {
    const Vec2u size = scene->camera()->resolution();
    const std::size_t pixels = size.product();
    const BufferBlocks blocks = blocks_of(buffer);
    auto serialized = std::make_shared<std::stringstream>();
    OutputStreamHandle out = serialized;
    const std::size_t floats = pixels * sizeof(T) / sizeof(float);
    if (settings.twoBufferVariance()) {
        FileUtils::streamWrite(out, blocks.half_a, floats);
        FileUtils::streamWrite(out, blocks.half_b, floats);
    } else {
        for (std::uint32_t i = 0; i < pixels; ++i) FileUtils::streamWrite(out, buffer[i]);
    }
    if (settings.sampleVariance()) FileUtils::streamWrite(out, blocks.squared_deviations, floats);
    FileUtils::streamWrite(out, blocks.counts, pixels);

    const OutputBuffer<T> own(size, settings);
    InputStreamHandle in = serialized;
    own.deserialize(in);
    own.save();
}

Evidence Render::Impl::collect(EvidenceMemory& memory, bool take) const {
    const float current_spp = static_cast<float>(integrator().currentSpp());
    Camera& camera = *scene->camera();
    const Vec2u size = camera.resolution();
    const std::uint32_t width = size.x(), pixels = size.product();
    Evidence evidence{static_cast<int>(width), static_cast<int>(size.y()), {}, nullptr, current_spp, nullptr};

    if (!plan.writes_features) {
        // Light also arrives by splatting, which no half knows of: only the whole image is sound.
        float* mean = memory.allocate(std::size_t{pixels} * 3);
        parallel_ranges(pixels, [&](std::uint32_t begin, std::uint32_t end) {
            for (std::uint32_t i = begin; i < end; ++i) {
                const Vec3f radiance =
                    camera.getLinear(static_cast<int>(i % width), static_cast<int>(i / width));
                std::copy_n(radiance.data(), 3, mean + std::size_t{i} * 3);
            }
        });
        evidence.quantities.push_back(Quantity{"color", 3, mean, nullptr, nullptr, nullptr});
        return evidence;
    }

    for_each_quantity([&](OutputBufferTypeEnum type, const char* name, auto member) {
        auto& buffer = camera.*member;
        constexpr std::size_t channels = sizeof((*buffer)[0]) / sizeof(float);
        const BufferBlocks blocks = blocks_of(*buffer);
        const std::size_t floats = pixels * channels;
        // What is taken is ours alone from here on; otherwise the render still needs it as it is.
        const auto array = [&](const float* block) {
            return take ? const_cast<float*>(block) : memory.copy(block, floats);
        };
        const Quantity quantity{name,
                                static_cast<int>(channels),
                                memory.allocate(floats),
                                array(blocks.half_a),
                                array(blocks.half_b),
                                array(blocks.squared_deviations)};
        parallel_ranges(pixels, [&](std::uint32_t begin, std::uint32_t end) {
            combine(blocks, channels, begin, end, quantity.mean, quantity.variance);
        });
        evidence.quantities.push_back(quantity);

        if (type == OutputColor) {
            const std::uint32_t *first = blocks.counts, *last = first + pixels;
            evidence.uniform_spp = static_cast<float>(*first);
            if (std::find_if(first, last, [=](std::uint32_t count) { return count != *first; }) != last) {
                evidence.spp = memory.allocate(pixels);
                std::copy(first, last, evidence.spp);
            }
        }
        if (take) memory.own(std::move(buffer));
    });
    return evidence;
}

Evidence Render::evidence() const {
    auto memory = std::make_shared<EvidenceMemory>();
    Evidence evidence = impl_->collect(*memory, false);
    evidence.memory = std::move(memory);
    return evidence;
}

Evidence Render::take_evidence() {
    auto memory = std::make_shared<EvidenceMemory>();
    Evidence evidence = impl_->collect(*memory, true);
    evidence.memory = std::move(memory);
    impl_->traceable.reset();
    impl_->scene.reset();
    return evidence;
}

const char* tungsten_version() { return VERSION_STRING; }

}  // namespace tungsten_dip
