// Loads, renders and saves with Tungsten, behind render.hpp.
#include "render.hpp"

#include <rapidjson/stringbuffer.h>
#include <rapidjson/writer.h>

#include <filesystem>
#include <future>
#include <map>
#include <mutex>
#include <sstream>
#include <stdexcept>
#include <utility>

#include "Version.hpp"
#include "camera_buffers.hpp"
#include "cameras/Camera.hpp"
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

// Tungsten's pools detach their workers when destroyed, which then read freed memory: pools are kept for
// good.
void use_threads(int threads) {
    static std::map<int, ThreadPool*> pools;
    ThreadPool*& pool = pools[threads];
    if (pool == nullptr) {
        ThreadUtils::startThreads(threads);
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

std::string one_line(const std::string& text) {
    std::istringstream words(text);
    std::string line;
    for (std::string word; words >> word;) line += (line.empty() ? "" : " ") + word;
    return line;
}

// What Integrator::resumeRender needs of itself, for our own reading of what it saves.
struct IntegratorState : Integrator {
    static constexpr auto load = &IntegratorState::loadState;
    static constexpr auto current_spp = &IntegratorState::_currentSpp;
    static constexpr auto advance_spp = &IntegratorState::advanceSpp;
};

bool has_complete_output(const RendererSettings& settings, int type) {
    bool complete = false;
    for (const OutputBufferSettings& output : settings.renderOutputs())
        if (output.type() == type) complete = output.twoBufferVariance() && output.sampleVariance();
    return complete;
}

// A state saved with other buffers cannot be read back, so renders that ask for all keep their own.
std::string resume_file_with_all_buffers(const std::string& path) {
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

// The settings' own reader takes our additions as if they stood in the scene file; what is not named stays.
void ask_for_buffers(Scene& scene, bool writes_features) {
    RendererSettings& settings = scene.rendererSettings();
    rapidjson::Document additions;
    additions.SetObject();
    auto& allocator = additions.GetAllocator();
    // Even and odd Sobol points mirror each other, so the halves would not be independent.
    additions.AddMember("stratified_sampler", false, allocator);
    const std::string resume_file = resume_file_with_all_buffers(settings.resumeRenderFile().asString());
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
    // For take_buffers: memory written to for the first time is most of what a hand-over would cost.
    std::vector<std::vector<float>> means;

    [[nodiscard]] Integrator& integrator() const {
        if (!traceable) throw std::runtime_error("this render is over: its buffers were taken");
        return traceable->integrator();
    }

    template <typename T>
    void save_as_asked(const OutputBuffer<T>& buffer, const OutputBufferSettings& settings) const;
};

Render::Render(const std::string& scene_path, const RenderOptions& options)
    : impl_(std::make_unique<Impl>()) {
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
    const Vec2u size = self.scene->camera()->resolution();
    if (std::uint64_t{size.x()} * size.y() > options.max_pixels)
        throw PictureTooLarge(std::to_string(size.x()) + " x " + std::to_string(size.y()));

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
    ask_for_buffers(*self.scene, writes_features);
    if (output_directory) settings.setOutputDirectory(*output_directory);
    for (std::size_t i = 0; i < own_outputs; ++i) {  // a later entry replaces an earlier one, as in Tungsten
        const OutputBufferSettings& output = settings.renderOutputs()[i];
        if (output.type() != OutputColor && !writes_features) continue;
        self.incomplete_outputs.erase(output.type());
        if (!output.twoBufferVariance() || !output.sampleVariance())
            self.incomplete_outputs.emplace(output.type(), output);
    }

    const std::uint32_t seed = options.seed.value_or(stock_seed);
    self.traceable.reset(self.scene->makeTraceable(seed));
    self.total_spp = settings.spp();
    self.means = means_for(*self.scene->camera(), writes_features);
    rapidjson::Document document;
    self.plan = RenderPlan{
        .integrator = self.scene->integrator()->toJson(document.GetAllocator())["type"].GetString(),
        .tonemap = self.scene->camera()->tonemapOp().toString(),
        .output_file = absolute_name(settings.outputFile()),
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
    bool adaptive = false;
    bool stratified = false;
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

// Reads our buffer's samples into one with the scene's own settings, which then writes its files as ever.
template <typename T>
void Render::Impl::save_as_asked(const OutputBuffer<T>& buffer, const OutputBufferSettings& settings) const {
    const Vec2u size = scene->camera()->resolution();
    const std::size_t pixels = size.product();
    const BufferBlocks blocks = blocks_of(buffer);
    const auto serialized = std::make_shared<std::stringstream>();
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

RenderBuffers Render::buffers() const {
    const std::uint32_t spp = current_spp();  // throws where there is no scene any more
    return copied_buffers(*impl_->scene->camera(), spp, impl_->plan.writes_features);
}

RenderBuffers Render::take_buffers() {
    const std::uint32_t spp = current_spp();  // throws where there is no scene any more
    RenderBuffers buffers =
        taken_buffers(*impl_->scene->camera(), spp, impl_->plan.writes_features, std::move(impl_->means));
    impl_->traceable.reset();
    impl_->scene.reset();
    return buffers;
}

const char* tungsten_version() { return VERSION_STRING; }

}  // namespace tungsten_dip
