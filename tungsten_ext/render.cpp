// The hook: Tungsten's scene, integrator and camera behind render.hpp.
#include "render.hpp"

#include <Version.hpp>
#include <algorithm>
#include <cameras/Camera.hpp>
#include <cameras/OutputBuffer.hpp>
#include <cameras/Tonemap.hpp>
#include <cstring>
#include <filesystem>
#include <future>
#include <integrators/path_tracer/PathTraceIntegrator.hpp>
#include <io/DirectoryChange.hpp>
#include <io/FileUtils.hpp>
#include <io/ImageIO.hpp>
#include <io/JsonDocument.hpp>
#include <io/Scene.hpp>
#include <io/StringUtils.hpp>
#include <map>
#include <mutex>
#include <primitives/EmbreeUtil.hpp>
#include <renderer/TraceableScene.hpp>
#include <sstream>
#include <stdexcept>
#include <streambuf>
#include <thread/ThreadPool.hpp>
#include <thread/ThreadUtils.hpp>
#include <thread>
#include <utility>
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

template <typename T>
struct BufferBlocks {
    const T* half_a;
    const T* half_b;
    const T* squared_deviations;
    const std::uint32_t* counts;
};

// Only for buffers with halves and variance, which is what Render asks for.
template <typename T>
BufferBlocks<T> blocks_of(const OutputBuffer<T>& buffer) {
    static_assert(sizeof(Vec3f) == 3 * sizeof(float));
    BlockAddresses addresses;
    OutputStreamHandle stream = std::make_shared<std::ostream>(&addresses);
    buffer.serialize(stream);
    if (addresses.blocks.size() != 4)
        throw std::runtime_error(
            "expected an output buffer with halves and variance; this Tungsten serializes another");
    const auto at = [&](std::size_t i) { return static_cast<const void*>(addresses.blocks[i]); };
    return {static_cast<const T*>(at(0)), static_cast<const T*>(at(1)), static_cast<const T*>(at(2)),
            static_cast<const std::uint32_t*>(at(3))};
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
struct EvidenceMemory {
    std::vector<std::shared_ptr<void>> buffers;
    std::vector<std::unique_ptr<float[]>> arrays;

    float* allocate(std::size_t floats) {
        arrays.emplace_back(new float[floats]);
        return arrays.back().get();
    }
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

bool Render::resume() {
    const DirectoryChange context(impl_->input_directory);
    return impl_->integrator().resumeRender(*impl_->scene);
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
    const BufferBlocks<T> blocks = blocks_of(buffer);
    auto serialized = std::make_shared<std::stringstream>();
    OutputStreamHandle out = serialized;
    if (settings.twoBufferVariance()) {
        FileUtils::streamWrite(out, blocks.half_a, pixels);
        FileUtils::streamWrite(out, blocks.half_b, pixels);
    } else {
        for (std::uint32_t i = 0; i < pixels; ++i) FileUtils::streamWrite(out, buffer[i]);
    }
    if (settings.sampleVariance()) FileUtils::streamWrite(out, blocks.squared_deviations, pixels);
    FileUtils::streamWrite(out, blocks.counts, pixels);

    const OutputBuffer<T> own(size, settings);
    InputStreamHandle in = serialized;
    own.deserialize(in);
    own.save();
}

Evidence Render::Impl::collect(EvidenceMemory& memory, bool take) const {
    integrator();  // throws where the render is over
    Camera& camera = *scene->camera();
    const Vec2u size = camera.resolution();
    const std::uint32_t width = size.x(), pixels = size.product();
    Evidence evidence{static_cast<int>(size.x()),
                      static_cast<int>(size.y()),
                      {},
                      nullptr,
                      static_cast<float>(traceable->integrator().currentSpp()),
                      nullptr};

    for_each_quantity([&](OutputBufferTypeEnum type, const char* name, auto member) {
        auto& buffer = camera.*member;
        if (!buffer || (type != OutputColor && !plan.writes_features)) return;
        using T = std::decay_t<decltype((*buffer)[0])>;
        constexpr int channels = sizeof(T) / sizeof(float);
        const BufferBlocks<T> blocks = blocks_of(*buffer);
        const std::size_t floats = std::size_t{pixels} * channels;
        // Taken arrays are the camera's own, which nobody else sees any more; otherwise they are copied.
        const auto own = [&](const T* block) {
            if (take) return const_cast<T*>(block);
            float* copy = memory.allocate(floats);
            std::memcpy(copy, block, floats * sizeof(float));
            return reinterpret_cast<T*>(copy);
        };
        T* mean = reinterpret_cast<T*>(memory.allocate(floats));
        // Elsewhere light also arrives by splatting, which no half knows of: only the whole image is sound.
        const bool halves = plan.writes_features;
        T* variance = halves ? own(blocks.squared_deviations) : nullptr;
        parallel_ranges(pixels, [&](std::uint32_t begin, std::uint32_t end) {
            for (std::uint32_t i = begin; i < end; ++i) {
                if (halves) {
                    const float n = static_cast<float>(blocks.counts[i]);
                    mean[i] = (*buffer)[i];
                    variance[i] = variance[i] / std::max(1.0f, n * (n - 1.0f));
                } else if constexpr (channels == 3) {
                    mean[i] = camera.getLinear(static_cast<int>(i % width), static_cast<int>(i / width));
                }
            }
        });
        evidence.quantities.push_back(
            Quantity{name, channels, reinterpret_cast<float*>(mean),
                     halves ? reinterpret_cast<float*>(own(blocks.half_a)) : nullptr,
                     halves ? reinterpret_cast<float*>(own(blocks.half_b)) : nullptr,
                     reinterpret_cast<float*>(variance)});

        if (type == OutputColor && halves) {
            const std::uint32_t* counts = blocks.counts;
            const auto [fewest, most] = std::minmax_element(counts, counts + pixels);
            evidence.uniform_spp = static_cast<float>(*most);
            if (*fewest != *most) {
                evidence.spp = memory.allocate(pixels);
                std::copy(counts, counts + pixels, evidence.spp);
            }
        }
        if (take) memory.buffers.emplace_back(std::move(buffer));
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

void save_ldr(const std::string& path, std::span<const float> radiance, int width, int height,
              const std::string& tonemap) {
    const Tonemap::Type op(tonemap);
    std::vector<uint8> image(radiance.size());
    for (std::size_t i = 0; i + 2 < radiance.size(); i += 3) {
        const Vec3f linear = max(Vec3f(radiance[i], radiance[i + 1], radiance[i + 2]), Vec3f(0.0f));
        const Vec3f encoded = Tonemap::tonemap(op, linear) * 255.0f;
        for (unsigned c = 0; c < 3; ++c)
            image[i + c] = encoded[c] > 0.0f ? static_cast<uint8>(std::min(encoded[c], 255.0f)) : uint8{0};
    }
    if (!ImageIO::saveLdr(Path(path), image.data(), width, height, 3))
        throw std::runtime_error(path + ": could not be written; check the folder and its free space");
}

const char* tungsten_version() { return VERSION_STRING; }

}  // namespace tungsten_dip
